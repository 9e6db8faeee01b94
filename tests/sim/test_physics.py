"""Both engines: same result, limits kept, finite in contact."""

from __future__ import annotations

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax.errors import ConfigError
from apnpql_jax.sim import engines, motors
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.sim.scene import load_scene

ENGINES = ("native", "mjx")


def play(step, state, velocities, close):
  """Returns the states after each control period, stacked over time."""
  states = []
  for velocity, grip in zip(velocities, close, strict=True):
    state = step(state, velocity, grip)
    states.append(state)
  return jax.tree.map(lambda *x: np.stack(x), *states)


@pytest.fixture(scope="module")
def random_play(engines, resets):
  """Returns the start, and seven periods of the same random actions in both engines.

  The arm starts high above the table: in contact the engines diverge chaotically.
  """
  resets = resets.replace(qpos=resets.qpos.at[:, 1].add(-0.5))
  worlds = resets.qpos.shape[0]
  rng = np.random.default_rng(0)
  velocities = rng.uniform(-1, 1, (7, worlds, 6)).astype(np.float32)
  close = rng.integers(0, 2, (7, worlds)).astype(np.float32)
  states = {n: play(engines[n], resets, velocities, close) for n in ENGINES}
  return resets, states


def test_engines_agree(random_play, task):
  """The same actions lead to the same motion."""
  _, states = random_play
  native, mjx = states["native"], states["mjx"]
  np.testing.assert_allclose(native.qpos, mjx.qpos, atol=1e-3)
  np.testing.assert_allclose(native.qpos[..., :6], mjx.qpos[..., :6], atol=5e-5)
  np.testing.assert_allclose(native.qvel[..., :6], mjx.qvel[..., :6], atol=5e-3)
  np.testing.assert_allclose(native.time, mjx.time, rtol=1e-5)


def test_a_step_starts_from_its_state_alone(engines, resets):
  """C MuJoCo keeps the solver's warm start and more in its data between two steps."""
  worlds = len(resets.qpos)
  still, down = jnp.zeros(worlds), jnp.zeros((worlds, 6)).at[:, 1].set(1.0)
  low = play(engines["native"], resets, [down] * 12, [still] * 12)
  state = jax.tree.map(lambda x: jnp.asarray(x[-1]), low)
  first = engines["native"](state, down, still)
  engines["native"](resets, -down, still + 1.0)
  again = engines["native"](state, down, still)
  for one, other in zip(*map(jax.tree.leaves, (first, again)), strict=True):
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ENGINES)
def test_a_sliding_plate_stops_by_coulomb_friction(engines, task, resets, name: str):
  """It slides v^2 / (2 mu g) in both engines, with the friction of the MJCF."""
  plate, dof = task.scene.free_joint("plate")
  worlds = resets.qpos.shape[0]
  speed = np.linspace(0.15, 0.45, worlds)
  state = resets.replace(qvel=resets.qvel.at[:, dof].set(speed))
  for _ in range(5):
    state = engines[name](state, jnp.zeros((worlds, 6)), jnp.ones(worlds))
  moved = np.asarray(state.qpos - resets.qpos)[:, plate : plate + 3]
  friction = 0.2
  np.testing.assert_allclose(moved[:, 0], speed**2 / (2 * friction * 9.81), rtol=0.1)
  np.testing.assert_allclose(moved[:, 1:], 0.0, atol=2e-3)
  assert np.abs(state.qvel[:, dof : dof + 3]).max() < 0.02


def test_free_bodies_follow_the_accelerations_of_an_unconverged_solver(task, resets):
  """After one iteration the solver's forces do not match its accelerations.

  The plate's inertia is so small that the residual would throw it.
  """
  model = copy.copy(task.scene.model)
  model.opt.iterations = 1
  scene = dataclasses.replace(task.scene, model=model)
  engine = MjxPhysics(scene, substeps=1)
  worlds = resets.qpos.shape[0]
  plate, dof = task.scene.free_joint("plate")
  speed = np.random.default_rng(0).normal(size=(worlds, 6)) * 0.3
  state = resets.replace(
    qpos=resets.qpos.at[:, plate + 2].add(-0.002),
    qvel=resets.qvel.at[:, dof : dof + 6].set(speed),
  )
  after = jax.jit(engine.step)(state, jnp.zeros((worlds, 6)), jnp.zeros(worlds))
  gained = np.asarray(after.qvel - state.qvel)[:, dof : dof + 6]
  expected = model.opt.timestep * np.asarray(after.qacc_warmstart)[:, dof : dof + 6]
  np.testing.assert_allclose(gained, expected, atol=1e-3)


@pytest.mark.parametrize("name", ENGINES)
def test_velocity_and_acceleration_limits_hold(random_play, name: str):
  """Random actions stay within the limits and reach that of the acceleration."""
  resets, states = random_play
  velocity = states[name].qvel[..., :6]
  assert np.abs(velocity).max() <= motors.MAX_VELOCITY + 0.02
  before = np.concatenate([np.asarray(resets.qvel[None, :, :6]), velocity[:-1]])
  acceleration = (velocity - before) / 0.15
  assert np.abs(acceleration).max() <= motors.MAX_ACCELERATION * 1.05
  # The limit is active: random commands request more.
  assert np.abs(acceleration).max() > motors.MAX_ACCELERATION * 0.9


@pytest.mark.parametrize("name", ENGINES)
def test_commanded_velocity_is_reached_up_to_the_limit(engines, resets, name: str):
  """Eight control periods suffice from rest; the last joint is commanded too much."""
  worlds = resets.qpos.shape[0]
  desired = jnp.tile(jnp.array([0.3, -0.1, 0.1, -0.2, 0.2, -1.5]), (worlds, 1))
  state = resets
  for _ in range(8):
    state = engines[name](state, desired, jnp.ones(worlds))
  reached = desired.at[:, 5].set(-motors.MAX_VELOCITY)
  np.testing.assert_allclose(state.qvel[:, :6], reached, atol=5e-3)


@pytest.mark.parametrize("name", ENGINES)
def test_arm_commanded_into_the_table_stays_finite(engines, resets, task, name: str):
  """The arm neither accelerates without bound nor penetrates the table."""
  scene = task.scene
  state = resets
  down = jnp.tile(jnp.array([0.0, 1.0, 0.3, -0.5, 0.0, 0.0]), (resets.qpos.shape[0], 1))
  for _ in range(20):
    state = engines[name](state, down, jnp.zeros(down.shape[0]))
    assert np.isfinite(state.qpos).all() and np.isfinite(state.qvel).all()
  assert np.abs(state.qvel[:, :6]).max() < 3.0
  kinematics = make_kinematics(scene)(state)
  tips = kinematics.geom_xpos[
    :, [scene.id("geom", g) for g in ("r_tip", "l_tip", "hand")], 2
  ]
  assert tips.min() > -0.02


@pytest.mark.parametrize("name", ENGINES)
def test_gripper_closes_at_its_speed(engines, resets, task, name: str):
  """The pad gap shrinks by 75 mm/s, as in the manufacturer's manual."""
  scene = task.scene
  fingers = slice(scene.gripper_qpos, scene.gripper_qpos + 4)
  state = resets.replace(qpos=resets.qpos.at[:, fingers].set(0.2))
  still, close = jnp.zeros((resets.qpos.shape[0], 6)), jnp.ones(resets.qpos.shape[0])
  gaps = []
  for _ in range(6):
    state = engines[name](state, still, close)
    gaps.append(2 * 0.057 * np.cos(state.qpos[:, scene.gripper_qpos] + np.pi / 6))
  speed = -np.diff(gaps, axis=0) / 0.15
  np.testing.assert_allclose(speed, motors.GRIPPER_SPEED, rtol=0.12)
  angles = np.asarray(state.qpos[:, fingers])
  np.testing.assert_allclose(angles, angles[:, :1] * np.ones(4), atol=0.02)


@pytest.mark.parametrize("name", ENGINES)
def test_no_command_moves_the_gripper_faster_than_0_or_1(engines, resets, task, name):
  """Such as those of a policy whose actions are all in [-1, 1]."""
  fingers = slice(task.scene.gripper_qpos, task.scene.gripper_qpos + 4)
  state = resets.replace(qpos=resets.qpos.at[:, fingers].set(0.5))
  worlds = len(resets.qpos)
  for command, limit in ((-1.0, 0.0), (2.0, 1.0)):
    beyond, within = (
      engines[name](state, jnp.zeros((worlds, 6)), jnp.full(worlds, close))
      for close in (command, limit)
    )
    np.testing.assert_array_equal(beyond.qpos, within.qpos)
    assert (np.abs(within.qpos - state.qpos)[:, fingers] > 0.05).all()


def test_kinematics_agree_with_mujoco(task, resets):
  """All poses equal those of C MuJoCo."""
  scene = task.scene
  kinematics = make_kinematics(scene)(resets)
  data = mujoco.MjData(scene.model)
  for i in range(4):
    data.qpos[:] = resets.qpos[i]
    data.mocap_pos[:] = resets.mocap_pos[i]
    data.mocap_quat[:] = resets.mocap_quat[i]
    mujoco.mj_forward(scene.model, data)
    for name in ("geom_xpos", "site_xpos", "cam_xpos"):
      np.testing.assert_allclose(
        getattr(kinematics, name)[i], getattr(data, name), atol=1e-5
      )
    for name in ("geom_xmat", "site_xmat", "cam_xmat"):
      expected = getattr(data, name).reshape(-1, 3, 3)
      np.testing.assert_allclose(getattr(kinematics, name)[i], expected, atol=1e-5)


def test_an_unknown_backend_is_rejected(task):
  """The error lists the valid backends."""
  with pytest.raises(ConfigError, match="choose from auto, mjx, native"):
    engines.make_physics("bullet", task.scene, substeps=30)


MINIMAL = """
<mujoco>
  <compiler angle="radian"/>
  <option {option}/>
  <worldbody>
    <body><joint name="{joint}"/><geom size=".1"/><site name="tool"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
  ("option", "joint", "message"),
  [
    ("noslip_iterations='3'", "elbow", "noslip_iterations"),
    *(
      (f"integrator='{name}'", "elbow", "option/integrator (valid: implicitfast)")
      for name in ("Euler", "RK4", "implicit")
    ),
    ("solver='PGS'", "elbow", "valid: CG, Newton"),
    ("integrator='implicitfast'", "elbow", "no joint 'shoulder_pan' (valid: elbow)"),
  ],
)
def test_unsupported_scenes_are_rejected(tmp_path, option, joint, message):
  """The one-line error names the feature or the missing joint."""
  path = tmp_path / "scene.xml"
  path.write_text(MINIMAL.format(option=option, joint=joint))
  with pytest.raises(ConfigError) as error:
    load_scene(path)
  assert message in str(error.value) and "\n" not in str(error.value)


def test_the_error_for_a_missing_camera_lists_the_others(task):
  """So a typo is easy to find."""
  with pytest.raises(ConfigError, match="no camera 'side' .valid: .*global"):
    task.scene.id("camera", "side")
