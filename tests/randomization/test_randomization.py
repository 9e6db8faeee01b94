"""Domain randomization: draws, derived constants, and no effect when it is off."""

from __future__ import annotations

import copy
import dataclasses

from hand_made import painted, randomized
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.cli.new_task import NewTask, new_task
from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import camera_renderer
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.randomization.draw import free_bodies
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.render import Lighting
from apnpql_jax.sim import arm, engines, motors, physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.training.rollout import FILMED, expert_policy, make_player

WORLDS = 8
ALL = RandomizationConfig(surroundings=0.4)
NONE = RandomizationConfig(
  **{field.name: 0.0 for field in dataclasses.fields(RandomizationConfig)}
)
CONFIG = EnvConfig(obs="state", backend="native", bank_rows=256, time_limit_s=0.45)

SIZES = {
  "geom_size",
  "geom_pos",
  "geom_aabb",
  "geom_rbound",
  "body_ipos",
  "body_inertia",
  "body_invweight0",
  "dof_M0",
  "dof_invweight0",
}
CHANGES = {
  "color": {"geom_rgba", "background"},
  "surroundings": {"geom_rgba", "background"},
  "texture": {"waves", "odd_rgb", "grain"},
  "light_turn": {"light_dir"},
  "light_level": {"light_ambient", "light_diffuse"},
  "camera_shift": {"cam_pos"},
  "camera_turn": {"cam_quat"},
  "field_of_view": {"cam_fovy"},
  "table_height": {"body_pos"},
  "table_tilt": {"body_quat"},
  "table_turn": {"body_quat"},
  "size": SIZES,
  "shape": SIZES,
  "mass": {
    "body_mass",
    "body_subtreemass",
    "body_inertia",
    "body_invweight0",
    "dof_M0",
    "dof_invweight0",
  },
  "friction": {"pair_friction"},
  "damping": {"dof_damping"},
  "delay_s": {"control_delay"},
  "gripper_speed": {"gripper_speed"},
}


def _states(task, worlds: int = WORLDS) -> physics.PhysicsState:
  draw = task.sample_resets(np.random.default_rng(3), worlds)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw))


def _randomized(task, config=ALL, *, seed: int = 0) -> physics.PhysicsState:
  randomize = jax.jit(make_randomize(config, task.scene))
  return randomize(_states(task), jax.random.split(jax.random.key(seed), WORLDS))


@pytest.fixture(scope="module")
def drawn(task) -> physics.PhysicsState:
  return _randomized(task)


def _kinematics(task):
  return make_kinematics(task.scene)


def _bits(tree) -> list[bytes]:
  return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def test_every_setting_is_tested():
  assert set(CHANGES) == {f.name for f in dataclasses.fields(RandomizationConfig)}


@pytest.mark.parametrize("name", CHANGES)
def test_a_setting_changes_its_own_fields_only(task, name):
  config = dataclasses.replace(NONE, **{name: getattr(ALL, name)})
  before = _states(task)
  after = jax.eval_shape(
    make_randomize(config, task.scene), before, jax.random.split(jax.random.key(0), 8)
  )
  assert set(after.fields) - set(before.fields) == CHANGES[name]
  assert (after.command is not None) == (name == "delay_s")
  for field, value in after.fields.items():
    assert not value.weak_type, field
    if field not in physics.OWN_FIELDS:
      assert value.shape[1:] == getattr(task.scene.model, field).shape, field


def test_a_setting_does_not_change_what_the_others_draw(task, drawn):
  fewer = _randomized(
    task, dataclasses.replace(ALL, texture=0.0, mass=0.0, delay_s=0.0)
  )
  for field in ("geom_rgba", "cam_pos", "light_dir", "body_quat", "geom_size"):
    np.testing.assert_array_equal(fewer.fields[field], drawn.fields[field])
  assert "waves" not in fewer.fields and "body_mass" not in fewer.fields


def test_draws_fill_their_range_and_differ_between_worlds(task, drawn):
  model, fields = task.scene.model, {k: np.asarray(v) for k, v in drawn.fields.items()}
  body, plate = model.body("plate").id, model.geom("plate_floor").id
  ratios = {
    "mass": fields["body_mass"][:, body] / model.body_mass[body],
    "friction": fields["pair_friction"][:, 3, 0] / model.pair_friction[3, 0],
    "gripper_speed": fields["gripper_speed"] / motors.GRIPPER_SPEED,
    "field_of_view": fields["cam_fovy"][:, 0] / model.cam_fovy[0],
    "color": 1 + fields["geom_rgba"][:, plate, 1] - model.geom_rgba[plate, 1],
    "table_height": 1 + fields["body_pos"][:, 1, 2] - model.body_pos[1, 2],
    "shape": np.divide(*fields["geom_size"][:, plate, 1::-1].T)
    / np.divide(*model.geom_size[plate, 1::-1]),
  }
  for name, ratio in ratios.items():
    assert np.abs(ratio - 1).max() <= getattr(ALL, name) * 1.001, name
    assert np.ptp(ratio) > 0.5 * getattr(ALL, name), name
    assert len(np.unique(ratio)) == WORLDS, name
  delay = fields["control_delay"]
  assert delay.min() >= 0 and 0 < delay.max() <= 6  # Steps of 5 ms in 30 ms.
  light = fields["light_ambient"] + fields["light_diffuse"]
  assert light.max() <= 1.0 + 1e-6


def test_turns_lights_and_textures_fill_their_range(task, drawn):
  model, fields = task.scene.model, {k: np.asarray(v) for k, v in drawn.fields.items()}
  cameras = [
    turn_between(model.cam_quat[i], fields["cam_quat"][:, i]) for i in range(model.ncam)
  ]
  base = model.body("base").id
  # About the world's axes: the inverses turn about the base's own.
  table = turn_between(
    inverse(model.body_quat[base]), inverse(fields["body_quat"][:, base])
  )
  plain, odd = fields["geom_rgba"][..., :3], fields["odd_rgb"][:, : model.ngeom]
  plate = model.geom("plate_floor").id
  light, full = Lighting(), fields["light_ambient"] + fields["light_diffuse"] > 0.999
  level = [  # Brighter worlds are scaled down to one.
    fields["light_ambient"][~full] / light.ambient - 1,
    fields["light_diffuse"][~full] / light.diffuse - 1,
  ]
  for name, found in {
    "light_turn": fields["light_dir"] - model.light_dir,
    "camera_turn": np.stack(cameras),
    "table_tilt": table[:, :2],
    "table_turn": table[:, 2],
    "light_level": np.concatenate(level),
    "texture": (odd - plain)[:, plate],
  }.items():
    most = getattr(ALL, name)
    assert np.abs(found).max() <= 1.01 * most, name
    assert found.min() < -0.2 * most and found.max() > 0.2 * most, name
    assert np.abs(found).max() > 0.5 * most, name
  assert 0.5 * ALL.texture < fields["grain"].max() <= 2 * ALL.texture
  robot = model.body_rootid[model.dof_bodyid] == base
  added = (fields["dof_damping"] - model.dof_damping) / fields["dof_M0"]
  assert (added[:, ~robot] == 0).all() and added[:, robot].min() >= 0
  assert 0.5 * ALL.damping < added[:, robot].max() <= 1.001 * ALL.damping


def turn_between(quat: np.ndarray, turned: np.ndarray) -> np.ndarray:
  """Returns rotation vectors f64[*b, 3] about the own axes of ``quat`` f64[4]."""
  first, second = (Rotation.from_quat(np.roll(x, -1, axis=-1)) for x in (quat, turned))
  return (first.inv() * second).as_rotvec()


def inverse(quat: np.ndarray) -> np.ndarray:
  return quat * [1.0, -1.0, -1.0, -1.0]


def test_objects_are_scaled_within_their_range(task):
  fields = _randomized(task, dataclasses.replace(NONE, size=ALL.size)).fields
  plate = task.scene.model.geom("plate_floor").id
  ratio = np.asarray(fields["geom_size"])[:, plate] / task.scene.model.geom_size[plate]
  assert np.abs(ratio[:, :2] - 1).max() <= 1.001 * ALL.size
  assert np.ptp(ratio[:, 0]) > 0.5 * ALL.size
  np.testing.assert_allclose(ratio[:, 0], ratio[:, 1], rtol=1e-5)


@pytest.mark.parametrize(("camera", "share"), [("global", 1.0), ("wrist", 0.1)])
def test_each_camera_shifts_within_its_own_range(task, drawn, camera, share):
  index = task.scene.id("camera", camera)
  shift = drawn.fields["cam_pos"][:, index] - task.scene.model.cam_pos[index]
  limit = share * ALL.camera_shift
  assert 0.5 * limit < np.abs(shift).max() <= 1.001 * limit


def test_a_camera_on_a_stand_shifts_as_one_in_the_world():
  def add(spec: mujoco.MjSpec) -> None:
    tripod = spec.worldbody.add_body(name="tripod", pos=[0.0, 1.0, 0.5]).add_body()
    tripod.add_camera(name="side")

  scene = load_scene(mjcf_path("push_plate"), variants=[add])
  config = dataclasses.replace(NONE, camera_shift=ALL.camera_shift)
  shift = np.abs(
    randomized(scene, config).fields["cam_pos"][:, scene.id("camera", "side")]
  )
  assert 0.5 * ALL.camera_shift < shift.max() <= 1.001 * ALL.camera_shift


def test_one_factor_changes_the_friction_of_all_contacts():
  """Also of those by masks: here the plate lies on the table and on a shelf in it."""

  def add(spec: mujoco.MjSpec) -> None:
    shelf = spec.worldbody.add_geom(name="shelf", type=mujoco.mjtGeom.mjGEOM_BOX)
    shelf.size, shelf.pos, shelf.conaffinity = [0.1] * 3, [0.5, -0.2, -0.0999], 1
    spec.geom("plate_base").contype = 1

  scene = load_scene(mjcf_path("push_plate"), variants=[add])
  state = randomized(scene, dataclasses.replace(NONE, friction=ALL.friction))
  factors = []
  for world in range(WORLDS):
    frictions = []
    for fields in ({}, state.fields):
      model = copy.copy(scene.model)
      for name, value in fields.items():
        getattr(model, name)[:] = value[world]
      data = mujoco.MjData(model)
      data.qpos[:] = scene.keyframe("neutral")
      mujoco.mj_forward(model, data)
      frictions.append(data.contact.friction.copy())
    touching = {scene.model.geom(geom).name for geom in data.contact.geom.flat}
    assert touching == {"plate_base", "table", "shelf"}
    factors.append(np.divide(*frictions[::-1]))
    np.testing.assert_allclose(factors[-1], factors[-1][0, 0], rtol=1e-5)
  assert np.ptp([factor[0, 0] for factor in factors]) > 0.5 * ALL.friction


def test_inertia_is_proportional_to_mass(task):
  """Without changes of size or shape; the robot keeps its mass."""
  model = task.scene.model
  fields = _randomized(task, dataclasses.replace(NONE, mass=ALL.mass)).fields
  heavy = model.body_mass > 0
  mass = np.asarray(fields["body_mass"])[:, heavy] / model.body_mass[heavy]
  inertia = np.asarray(fields["body_inertia"])[:, heavy] / model.body_inertia[heavy]
  np.testing.assert_allclose(inertia, np.repeat(mass[..., None], 3, -1), rtol=1e-5)
  changed = [model.body(i).name for i in np.flatnonzero(heavy)[np.ptp(mass, 0) > 0.1]]
  assert changed == ["plate"]


@pytest.mark.parametrize("variants", [1, 2])
def test_materials_and_textures_keep_their_color(tmp_path, variants):
  """Also where variants of the scene have colors of their own."""

  def repaint(spec: mujoco.MjSpec) -> None:
    spec.geom("goal").rgba = [0.1, 0.2, 0.3, 1]

  path, edits = painted(tmp_path), [lambda _: None, repaint]
  scene, alone = load_scene(path, variants=edits[:variants]), load_scene(path)
  states = (
    randomized(scene, NONE),
    randomized(scene, dataclasses.replace(NONE, color=1e-6)),
  )
  assert "geom_rgba" in states[1].fields
  for name in ("global", "wrist"):
    poses = [make_kinematics(scene)(state) for state in states]
    found = [camera_renderer(CONFIG, scene, name, (72, 96))(x) for x in poses]
    plain = camera_renderer(CONFIG, alone, name, (72, 96))(poses[0].replace(fields={}))
    for image in found:
      assert np.abs(np.asarray(image, int) - np.asarray(plain, int)).max() <= 1


def test_geoms_of_the_robot_change_their_color_together(task, drawn):
  model = task.scene.model
  change = np.asarray(drawn.fields["geom_rgba"])[0] - model.geom_rgba
  arm_geoms = [model.geom(name).id for name in ("base", "forearm", "wrist_2")]
  for geom in arm_geoms:
    np.testing.assert_allclose(change[geom], change[arm_geoms[0]], atol=1e-6)
  np.testing.assert_array_equal(change[:, 3], 0.0)


def test_surroundings_are_table_and_background_alone(task):
  model = task.scene.model
  fields = _randomized(task, dataclasses.replace(NONE, surroundings=0.2)).fields
  change = np.asarray(fields["geom_rgba"]) - model.geom_rgba
  table, background = model.geom("table").id, np.asarray(fields["background"])
  assert np.abs(np.delete(change, table, axis=1)).max() == 0.0
  assert 0.1 < np.abs(change[:, table]).max() <= 0.2001
  assert np.ptp(background, axis=0).min() > 0.1
  assert not np.allclose(change[:, table, :3], background - background.mean(0))


@pytest.fixture(scope="module", params=task_names())
def any_task(request):
  """Returns a task and randomized worlds of it."""
  task = make_task(request.param)
  return task, _randomized(task, seed=1)


def _model(task, state: physics.PhysicsState, world: int) -> mujoco.MjModel:
  """Returns the model of one world, without the constants that MuJoCo derives."""
  model = copy.copy(task.scene.model)
  given = (
    "body_mass body_inertia body_ipos body_pos body_quat geom_size geom_pos "
    "dof_damping cam_pos cam_quat"
  )
  for field in given.split():
    getattr(model, field)[:] = np.asarray(state.fields[field][world])
  return model


def _data(model: mujoco.MjModel, state: physics.PhysicsState, world: int):
  """Computes the poses of one world in C MuJoCo."""
  data = mujoco.MjData(model)
  for name in ("qpos", "mocap_pos", "mocap_quat"):
    getattr(data, name)[:] = np.asarray(getattr(state, name)[world])
  mujoco.mj_kinematics(model, data)
  mujoco.mj_camlight(model, data)
  return data


def test_derived_constants_are_those_of_mujoco(any_task):
  task, state = any_task
  derived = "body_subtreemass body_invweight0 dof_invweight0 dof_M0".split()
  for world in range(2):
    model = _model(task, state, world)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for field in derived:
      np.testing.assert_allclose(
        state.fields[field][world], getattr(model, field), rtol=2e-4, err_msg=field
      )


def test_objects_of_any_size_and_shape_stand_on_the_table(any_task):
  task, state = any_task
  sizes = np.asarray(state.fields["geom_size"])
  for world in range(WORLDS):
    model = _model(task, state, world)
    data, table = _data(model, state, world), model.geom("table").id
    solid = np.union1d(model.pair_geom1, model.pair_geom2)
    for body in np.flatnonzero(free_bodies(model)):
      geoms = solid[model.geom_bodyid[solid] == body]
      gaps = [mujoco.mj_geomDistance(model, data, table, g, 1.0, None) for g in geoms]
      assert abs(min(gaps)) < 1e-5
      assert np.ptp(sizes[:, geoms], axis=0).max() > 0.0003


def test_poses_agree_with_c_mujoco(task, drawn):
  """Cameras, robot and objects of randomized worlds."""
  kinematics = _kinematics(task)(drawn)
  for world in range(WORLDS):
    data = _data(_model(task, drawn, world), drawn, world)
    for name in ("geom_xpos", "cam_xpos", "site_xpos", "geom_xmat", "cam_xmat"):
      expected = getattr(data, name)
      found = np.asarray(getattr(kinematics, name)[world]).reshape(expected.shape)
      np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=name)
  camera = np.asarray(kinematics.cam_xpos)[:, task.scene.id("camera", "global")]
  assert np.ptp(camera, axis=0).min() > 0.5 * ALL.camera_shift


def test_forward_kinematics_include_the_pose_of_the_base(task, drawn):
  kinematics = _kinematics(task)(drawn)
  chain = arm.make_chain(task.scene)
  joints = drawn.qpos[:, None, task.scene.arm_qpos]
  moved = arm.with_base(chain, task.scene, drawn.fields)
  position, rotation, _ = arm.forward(moved, joints)
  site = task.scene.tool_site
  np.testing.assert_allclose(position[:, 0], kinematics.site_xpos[:, site], atol=1e-5)
  np.testing.assert_allclose(rotation[:, 0], kinematics.site_xmat[:, site], atol=1e-5)
  own, _, _ = arm.forward(chain, joints)
  assert np.linalg.norm(own - position, axis=-1).max() > 0.01


def test_a_delayed_command_equals_two_commands_in_sequence(task, drawn):
  """An engine steps through the former command, then through the new one."""
  former, command = (
    jnp.asarray(np.random.default_rng(i).uniform(-1, 1, (WORLDS, 7)), jnp.float32)
    for i in range(2)
  )
  former, command = (x.at[:, 6].set(x[:, 6] > 0) for x in (former, command))
  state = drawn.replace(command=former)
  engine = engines.make_physics("native", task.scene, substeps=10)
  after = engine.step(state, command[:, :6], command[:, 6])
  np.testing.assert_array_equal(after.command, command)
  for world in range(WORLDS):
    steps = int(drawn.fields["control_delay"][world])
    one = jax.tree.map(lambda x: x[world : world + 1], drawn).replace(command=None)  # noqa: B023
    for count, action in ((steps, former), (10 - steps, command)):
      if count:
        part = engines.make_physics("native", task.scene, substeps=count)
        one = part.step(one, action[world, None, :6], action[world, None, 6])
    np.testing.assert_allclose(one.qpos[0], after.qpos[world], atol=1e-6)


def test_both_engines_move_the_same_worlds(task, drawn):
  velocity = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (WORLDS, 6)), "f4")
  close, moved = jnp.zeros(WORLDS), {}
  # Away from their limits, which the engines treat differently.
  fingers = slice(task.scene.gripper_qpos, task.scene.gripper_qpos + 4)
  drawn = drawn.replace(qpos=drawn.qpos.at[:, fingers].set(0.6))
  for name in ("native", "mjx"):
    engine = engines.make_physics(name, task.scene, substeps=10)
    step = jax.jit(engine.step)
    moved[name] = step(step(drawn, velocity, close), -velocity, close)
  np.testing.assert_allclose(moved["native"].qpos, moved["mjx"].qpos, atol=2e-4)
  plain = drawn.replace(fields={}, command=None)
  engine = engines.make_physics("native", task.scene, substeps=10)
  plain = engine.step(engine.step(plain, velocity, close), -velocity, close)
  assert np.abs(plain.qpos - moved["native"].qpos).max() > 2e-3


@pytest.fixture(scope="module")
def plain_env() -> Env:
  return make_env(CONFIG)


def _episodes(env: Env, *, seed: int = 0) -> EnvState:
  """Plays two episodes of three periods and the first instant of a third."""
  states = [env.reset(jnp.arange(4))]
  for key in jax.random.split(jax.random.key(seed), 8):
    states.append(env.step(states[-1], env.expert_action(states[-1]), key))
  return jax.tree.map(lambda *x: np.stack(x), *states)


def test_a_scene_without_free_bodies_is_randomized(tmp_path):
  """Such as the guide's, in which a ball hangs in the air."""
  new_task(NewTask(name="touch_ball", folder=tmp_path))
  scene = load_scene(tmp_path / "touch_ball.xml")
  assert not free_bodies(scene.model).any()
  state = randomized(scene, ALL)
  changed = set().union(*CHANGES.values()) - {"pair_friction"}  # It has no pairs.
  still = SIZES | CHANGES["mass"]
  for name in changed - still:
    assert len(np.unique(np.asarray(state.fields[name]), axis=0)) > 1, name
  for name in still:
    expected = np.broadcast_to(getattr(scene.model, name), state.fields[name].shape)
    np.testing.assert_allclose(state.fields[name], expected, rtol=1e-6)
  step = engines.make_physics("native", scene, substeps=30).step
  state = state.replace(mocap_quat=state.mocap_quat.at[..., 0].set(1.0))
  after = step(state, jnp.full((WORLDS, 6), 0.2), jnp.ones(WORLDS))
  assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))
  assert len(np.unique(np.asarray(after.qvel[:, :6]), axis=0)) == WORLDS


def test_a_plain_world_is_plain_after_randomized_ones(task, drawn):
  """Although C MuJoCo keeps the fields of the worlds that it has stepped."""
  step = engines.make_physics("native", task.scene, substeps=30).step
  moving, closed = jnp.full((WORLDS, 6), 0.5), jnp.ones(WORLDS)
  plain = _states(task)
  before = step(plain, moving, closed)
  assert _bits(step(drawn, moving, closed).qvel) != _bits(before.qvel)
  assert _bits(step(plain, moving, closed)) == _bits(before)


def test_zero_ranges_equal_no_randomization(plain_env):
  plain = dataclasses.replace(
    CONFIG, obs="pixels", global_size=(12, 16), wrist_size=(8, 12)
  )
  config = dataclasses.replace(plain, randomize=True, randomization=NONE)
  off, zero = (
    _episodes(Env(one, plain_env.task, plain_env._bank)) for one in (plain, config)
  )
  assert jax.tree.structure(off) == jax.tree.structure(zero)
  assert _bits(off) == _bits(zero)


def test_a_step_keeps_the_types_of_the_state(plain_env):
  """One compilation then serves every iteration, and a loop can play episodes."""
  config = dataclasses.replace(CONFIG, obs="pixels", shadows=True, randomize=True)
  env = Env(config, plain_env.task, plain_env._bank, lstm_instants=3)
  play = make_player(env, lambda noise: expert_policy(env, noise=noise))
  episodes = jax.eval_shape(play, 0.0, jnp.arange(4), jax.random.key(0))
  assert episodes.states.command.shape == (config.episode_steps + 1, FILMED, 7)
  start = jax.eval_shape(env.reset, jnp.arange(4))
  after = jax.eval_shape(env.step, start, jnp.zeros((4, 7)), jax.random.key(0))
  types = lambda x: (x.shape, x.dtype, x.weak_type)  # noqa: E731
  assert jax.tree.map(types, start) == jax.tree.map(types, after)
  assert not any(x.weak_type for x in jax.tree.leaves(start))


def test_each_episode_has_its_own_world(plain_env):
  env = Env(
    dataclasses.replace(CONFIG, randomize=True), plain_env.task, plain_env._bank
  )
  states = _episodes(env)
  fields = states.physics.fields
  for name in ("body_mass", "geom_rgba", "gripper_speed", "cam_pos"):
    value = np.asarray(fields[name]).reshape(9, 4, -1)
    same = (value[1:] == value[:-1]).all(-1)
    # The instants 0 to 3 are one episode, 4 to 7 the next.
    np.testing.assert_array_equal(same[[0, 1, 2, 4, 5, 6]], True)
    np.testing.assert_array_equal(same[[3, 7]], False)
  again = _episodes(env, seed=1).physics.fields
  assert _bits(jax.tree.map(lambda x: x[0], again)) == _bits(
    jax.tree.map(lambda x: x[0], fields)
  )
  assert _bits(jax.tree.map(lambda x: x[4], again)) != _bits(
    jax.tree.map(lambda x: x[4], fields)
  )
  # The reported tool position assumes the table of the scene file.
  observation = states.timestep.observation
  joints = observation.robot[..., -7:-1]
  position, _, _ = arm.forward(arm.make_chain(env.task.scene), joints)
  np.testing.assert_allclose(np.asarray(observation.tool), position, atol=1e-5)
