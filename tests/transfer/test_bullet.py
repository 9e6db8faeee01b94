"""PyBullet as a plant: the bodies of MuJoCo, moved as a real arm is."""

from __future__ import annotations

from collections.abc import Iterator
import sys
from types import SimpleNamespace
from typing import Any

from hand_made import painted
import mujoco
import numpy as np
import pytest

from apnpql_jax.colors import geom_rgba
from apnpql_jax.config.files import mjcf_path
from apnpql_jax.errors import ConfigError
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.virtual_arm import VirtualArm
from apnpql_jax.sim import motors
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.tasks import make_task, task_names
from apnpql_jax.tasks.pinch import finger_angle, pinch_height
from apnpql_jax.tasks.stack_box import SIDE
from apnpql_jax.transfer import bullet, friction
from apnpql_jax.transfer.bullet_plant import BulletPlant, with_fields
from apnpql_jax.transfer.condition import Condition
from apnpql_jax.transfer.urdf import write

PERIOD_S = 0.15
FIRST = np.array([0.4, -0.3, 0.3, 0.2, -0.3, 0.4])


@pytest.fixture(scope="module")
def scene() -> Scene:
  return make_task("stack_box").scene


@pytest.fixture(scope="module")
def plant(scene: Scene) -> Iterator[BulletPlant]:
  pytest.importorskip("pybullet")
  with BulletPlant(scene, latency_s=0.0, admittance=False) as plant:
    yield plant


CHAIN = """
<body name="lid" pos="0.7 0 0.3"><freejoint/><geom type="box" size="0.1 0.1 0.01"/>
  <body name="knob"><joint name="turn" type="hinge" axis="0 0 1"/>
    <geom type="sphere" size="0.02" pos="0 0 0.03"/></body></body>"""
DRAWER = """
<body name="drawer" pos="0.7 0 0.2"><joint name="pull" type="slide" axis="1 0 0"/>
  <geom type="box" size="0.1 0.1 0.03"/></body>"""
CONE = """
<geom name="cone" type="mesh" mesh="cone" pos="0.8 0.3 0.2"/></worldbody>
<asset><mesh name="cone" vertex="0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"/></asset><worldbody>"""
EGG = """
<geom name="egg" type="ellipsoid" size="0.02 0.03 0.04" pos="0.8 0.3 0.2"/>"""


@pytest.mark.parametrize(
  ("things", "words"),
  [
    (DRAWER, "the joint pull"),
    (CHAIN, "the joint turn"),
    (CONE, "geoms of the type mesh"),
    (DRAWER + EGG, "the joint pull and geoms of the type ellipsoid"),
  ],
)
def test_a_scene_that_bullet_lacks_is_refused(things, words, tmp_path):
  pytest.importorskip("pybullet")
  path = tmp_path / "kitchen.xml"
  path.write_text(
    f"""<mujoco><include file="{mjcf_path("arena")}"/><worldbody>{things}</worldbody>
      </mujoco>"""
  )
  scene = load_scene(path)
  refusal = f"kitchen.xml has {words}, which --physics bullet lacks"
  with pytest.raises(ConfigError, match=f"^{refusal}$"):
    BulletPlant(scene, latency_s=0.0, admittance=False)
  env: Any = SimpleNamespace(task=SimpleNamespace(scene=scene))
  with pytest.raises(ConfigError, match=f"^{refusal}$"):
    Condition(physics="bullet").make_worlds(env)


def begin(
  plant: BulletPlant, *, closed: bool = False, **fields: np.ndarray
) -> np.ndarray:
  """Starts from the keyframe; returns its qpos."""
  model = plant.scene.model
  qpos, data = plant.scene.keyframe("neutral"), mujoco.MjData(model)
  if closed:
    qpos[plant.scene.gripper_qpos : plant.scene.gripper_qpos + 4] = 1.1
  plant.begin(qpos, data.mocap_pos, data.mocap_quat, fields)
  return qpos


@pytest.mark.parametrize("name", task_names())
def test_bodies_have_the_masses_and_inertias_of_the_model(name):
  pytest.importorskip("pybullet")
  model = make_task(name).scene.model
  client = bullet.connect()
  bodies = bullet.Bodies(client, model)
  for body in range(1, model.nbody):
    if model.body_mocapid[body] >= 0:
      continue
    dynamics = client.getDynamicsInfo(*bodies.place[body])
    fixed = body == model.body("base").id  # PyBullet's base is fixed.
    assert dynamics[0] == (0 if fixed else pytest.approx(model.body_mass[body]))
    if not fixed:
      np.testing.assert_allclose(dynamics[2], model.body_inertia[body], rtol=1e-4)
  client.disconnect()


@pytest.mark.parametrize("name", task_names())
def test_state_is_that_of_mujoco_and_kinematics_agree(name):
  pytest.importorskip("pybullet")
  model = make_task(name).scene.model
  data, client = mujoco.MjData(model), bullet.connect()
  bodies, rng = bullet.Bodies(client, model), np.random.default_rng(0)
  for _ in range(5):
    for joint, at in enumerate(model.jnt_qposadr):
      if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
        quat = rng.normal(size=4)
        quat *= np.sign(quat[0]) / np.linalg.norm(quat)
        data.qpos[at : at + 7] = [*rng.uniform(-0.3, 0.3, 3), *quat]
      else:
        data.qpos[at] = rng.uniform(*model.jnt_range[joint])
    mujoco.mj_kinematics(model, data)
    bodies.reset(data.qpos, data.mocap_pos, data.mocap_quat)
    qpos, qvel = bodies.state()
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
      at = model.jnt_qposadr[joint]
      qpos[at + 3 : at + 7] *= np.sign(qpos[at + 3])
    np.testing.assert_allclose(qpos, data.qpos, atol=1e-6)
    np.testing.assert_array_equal(qvel, 0)
    for body in range(model.nbody):
      pos, mat = bodies.pose(body)
      np.testing.assert_allclose(pos, data.xpos[body], atol=1e-4)
      np.testing.assert_allclose(mat.ravel(), data.xmat[body], atol=1e-4)
  client.disconnect()


def test_velocity_of_an_object_is_that_of_its_frame():
  """The center of mass of this plate lies 3 mm above its frame."""
  pytest.importorskip("pybullet")
  model = make_task("push_plate").scene.model
  data, client = mujoco.MjData(model), bullet.connect()
  bodies, plate = bullet.Bodies(client, model), model.body("plate").id
  client.setPhysicsEngineParameter(fixedTimeStep=1e-3)
  data.qpos[:] = model.key("neutral").qpos
  data.qpos[-7:] = [0.5, 0.0, 1.0, *np.array([0.8, 0.2, 0.4, 0.4])]
  bodies.reset(data.qpos, data.mocap_pos, data.mocap_quat)
  client.resetBaseVelocity(bodies.place[plate][0], [0.1, 0.2, 0.3], [2.0, -1.0, 3.0])
  before, velocity = bodies.state()
  client.stepSimulation()
  change = np.zeros(model.nv)
  mujoco.mj_differentiatePos(model, change, 1e-3, before, bodies.state()[0])
  np.testing.assert_allclose(velocity[-6:], change[-6:], atol=0.01)
  client.disconnect()


def test_arm_follows_the_virtual_arm(plant):
  qpos, virtual = begin(plant), VirtualArm()
  virtual.reset(qpos[plant.scene.arm_qpos])
  for velocity in (FIRST, -FIRST, FIRST):
    plant.step(velocity, 0.0, PERIOD_S)
    for _ in range(round(PERIOD_S / TIMESTEP)):
      virtual.step(velocity)
    found, rate = plant.bodies.state()
    np.testing.assert_allclose(found[:6], virtual.position, atol=2e-3)
    np.testing.assert_allclose(rate[:6], virtual.velocity, atol=2e-2)


@pytest.mark.parametrize("latency_s", [0.03, 0.06])
def test_latency_shifts_the_motion(latency_s, scene, plant):
  begin(plant)
  path = follow(plant)
  shift = round(latency_s / TIMESTEP)
  with BulletPlant(scene, latency_s=latency_s, admittance=False) as late:
    begin(late)
    found = follow(late)
  np.testing.assert_allclose(found[shift:], path[:-shift], atol=1e-3)
  assert np.abs(found[shift:] - path[shift:]).max() > 5e-3


@pytest.mark.parametrize(("latency_s", "expected"), [(0.03, 1.0), (0.06, 0.83)])
def test_latency_limits_the_speed(latency_s, expected, scene):
  """The virtual arm waits for the measured one, which is late (0.05 rad at most)."""
  fast = np.array([0, 0, 0, 0, 0, 1.0])
  with BulletPlant(scene, latency_s=latency_s, admittance=False) as late:
    begin(late)
    for _ in range(14):
      late.step(fast, 0.0, PERIOD_S)
    assert late.bodies.state()[1][5] == pytest.approx(expected, abs=0.02)


def follow(plant: BulletPlant) -> np.ndarray:
  """Returns joint angles f64[time, 6] at every cycle of two periods."""
  path = []
  for _ in range(round(2 * PERIOD_S / TIMESTEP)):
    plant.step(FIRST, 0.0, TIMESTEP)
    path.append(plant.bodies.state()[0][:6])
  return np.array(path)


def test_servos_overcome_friction(plant):
  """Gravity does not turn the first joint, whose axis is vertical."""
  begin(plant)
  for _ in range(4):
    plant.step(np.array([0.3, 0, 0, 0, 0, 0]), 0.0, PERIOD_S)
  bodies, pan = plant.bodies, plant.scene.model.joint("shoulder_pan").id
  torque = bodies.client.getJointState(bodies.robot, bodies.joints[pan])[3]
  assert torque == pytest.approx(0.03 * 150.0, rel=0.01)  # N m


def test_delayed_commands_start_late(plant):
  """``control_delay`` counts steps of MuJoCo, 5 ms each."""
  begin(plant, control_delay=np.asarray(4.0))
  plant.step(FIRST, 0.0, 0.018)
  still = plant.bodies.state()[0][:6]
  np.testing.assert_allclose(still, plant.scene.keyframe("neutral")[:6], atol=1e-4)


def test_fingers_move_together_at_the_speed_of_the_motor(plant):
  qpos = begin(plant)
  seen = []
  for close in (1.0, 0.0):
    for _ in range(12):
      plant.step(np.zeros(6), close, PERIOD_S)
      fingers = plant.bodies.state()[0][6:10]
      np.testing.assert_allclose(fingers, fingers[0], atol=0.01)
      seen.append(fingers[0])
  assert qpos[6] == 0 and seen[11] == pytest.approx(1.1, abs=0.01)
  assert seen[-1] == pytest.approx(0.0, abs=0.01)
  gap = [2 * motors.FINGER_LENGTH * np.cos(q + motors.FINGER_ANGLE) for q in seen[:4]]
  np.testing.assert_allclose(-np.diff(gap) / PERIOD_S, motors.GRIPPER_SPEED, rtol=0.05)


def between_pads(data: mujoco.MjData) -> np.ndarray:
  """Returns where the center of a gripped box is."""
  tool = data.site("tool")
  return tool.xpos - float(pinch_height(SIDE)) * tool.xmat.reshape(3, 3)[:, 2]


def begin_with_box(plant: BulletPlant) -> mujoco.MjData:
  """Starts with the yellow box between the pads; returns that state in MuJoCo."""
  qpos = begin(plant)
  data = mujoco.MjData(plant.scene.model)
  qpos[6:10] = finger_angle(SIDE)
  data.qpos[:] = qpos
  mujoco.mj_kinematics(plant.scene.model, data)
  at, _ = plant.scene.free_joint("yellow")
  quat = np.zeros(4)
  mujoco.mju_mat2Quat(quat, data.site("tool").xmat)
  data.qpos[at : at + 7] = [*between_pads(data), *quat]
  plant.begin(data.qpos.copy(), data.mocap_pos, data.mocap_quat, {})
  return data


def test_pads_hold_a_box_that_the_arm_lifts(plant):
  data = begin_with_box(plant)
  pads = between_pads(data)
  plant.step(np.zeros(6), 1.0, PERIOD_S)
  for _ in range(6):
    plant.step(np.array([0.2, -0.2, 0, 0, 0, 0]), 1.0, PERIOD_S)
  data.qpos[:], _ = plant.bodies.state()
  mujoco.mj_kinematics(plant.scene.model, data)
  moved = between_pads(data)
  at, _ = plant.scene.free_joint("yellow")
  assert np.linalg.norm(moved - pads) > 0.03
  np.testing.assert_allclose(data.qpos[at : at + 3], moved, atol=3e-3)


def test_contacts_turn_with_the_hand(plant):
  """After half a turn with a box, all contacts push the pads apart."""
  begin_with_box(plant)
  model = plant.scene.model
  for _ in range(26):
    plant.step(np.array([0, 0, 0, 0, 0, 1.0]), 1.0, PERIOD_S)
  plant.step(np.zeros(6), 1.0, 0.02)
  bodies, pushes = plant.bodies, []
  for name, sign in (("r2", 1), ("l2", -1)):
    place = bodies.place[model.body(name).id]
    outward = sign * bodies.pose(model.body("gripper").id)[1][:, 1]
    box = bodies.place[model.body("yellow").id][0]
    for contact in bodies.client.getContactPoints(bodies.robot, box, place[1]):
      pushes.append(np.dot(contact[7], outward))
  assert len(pushes) >= 4 and min(pushes) > 0.9


def test_admittance_yields_to_the_table(scene):
  """The hand moves down onto it and slides away from the base."""
  pytest.importorskip("pybullet")
  down, forces = np.array([0, 0.25, 0, -0.25, 0, 0]), {}
  for admittance in (False, True):
    with BulletPlant(scene, latency_s=0.0, admittance=admittance) as plant:
      begin(plant, closed=True)
      for _ in range(17):
        plant.step(down, 1.0, PERIOD_S)
      felt = []
      for _ in range(round(3 * PERIOD_S / TIMESTEP)):
        plant.step(down, 1.0, TIMESTEP)
        felt.append(plant.wrench()[:3])
      forces[admittance] = np.mean(felt, axis=0)
  assert forces[False][2] > 50.0  # N, upward
  assert 0.0 < forces[True][2] < 0.5 * forces[False][2]
  # The base's y is the world's x.
  assert forces[False][1] < -10.0


def test_nothing_pushes_a_hand_in_the_air(plant):
  begin(plant, closed=True)
  plant.step(np.zeros(6), 1.0, PERIOD_S)
  np.testing.assert_array_equal(plant.wrench(), 0)


def test_frictions_of_the_pairs_become_factors():
  model = make_task("push_plate").scene.model
  factors = friction.sliding(model)
  plate, tip = model.body("plate").id, model.body("r2").id
  assert factors[0] * factors[plate] == pytest.approx(0.2)
  assert factors[tip] * factors[plate] == pytest.approx(0.3)
  assert friction.spinning(model) == {}
  model = make_task("place_plate").scene.model
  tip = model.body("r2").id
  assert friction.spinning(model)[tip] == pytest.approx(0.01)


def test_worlds_have_fields_of_their_own(scene):
  mass = scene.model.body_mass.astype(np.float32) * 2
  model = with_fields(
    scene.model, {"body_mass": mass, "gripper_speed": np.asarray(1.0)}
  )
  np.testing.assert_array_equal(model.body_mass, mass)
  assert scene.model.body_mass[1] != mass[1]


def test_a_randomized_world_stands_in_bullet_as_in_mujoco(plant):
  """A robot that stands lower and turned, a larger and heavier box."""
  model, box = plant.scene.model, plant.scene.model.body("yellow").id
  base = model.body("base").id
  pos, quat = model.body_pos.copy(), model.body_quat.copy()
  mass, size = model.body_mass.copy(), model.geom_size.copy()
  pos[base, 2], mass[box], size[model.geom("yellow").id] = -0.02, 0.2, 0.03
  quat[base] = [0.8, 0.0, 0.0, 0.6]
  qpos = begin(plant, body_pos=pos, body_quat=quat, body_mass=mass, geom_size=size)
  world = with_fields(model, {"body_pos": pos, "body_quat": quat})
  data = mujoco.MjData(world)
  data.qpos[:] = qpos
  mujoco.mj_kinematics(world, data)
  hand = model.body("gripper").id
  found, _ = plant.bodies.pose(hand)
  np.testing.assert_allclose(found, data.xpos[hand], atol=1e-4)
  client = plant.bodies.client
  assert client.getDynamicsInfo(*plant.bodies.place[box])[0] == pytest.approx(0.2)
  low, high = map(np.array, client.getAABB(*plant.bodies.place[box]))
  np.testing.assert_allclose(high - low, 0.06, atol=5e-3)


@pytest.mark.parametrize(
  ("condition", "words"),
  [
    (Condition(latency_ms=30), "--latency-ms needs --physics bullet"),
    (Condition(admittance=True), "--admittance needs --physics bullet"),
    (Condition("bullet", latency_ms=31), "--latency-ms 31 must be one of 0, 30, 60"),
  ],
)
def test_options_of_bullet_are_checked(condition, words):
  with pytest.raises(ConfigError, match=words):
    condition.check()


@pytest.mark.parametrize(
  ("condition", "option"),
  [
    (Condition("bullet"), "--physics bullet"),
    (Condition(renderer="tiny"), "--renderer tiny"),
  ],
)
def test_a_missing_package_is_named(condition, option, monkeypatch):
  monkeypatch.setitem(sys.modules, "pybullet", None)
  cure = f"{option} needs PyBullet: pip install 'apnpql-jax\\[transfer\\]'"
  with pytest.raises(ConfigError, match=cure):
    condition.check()


def test_links_have_the_colors_of_materials_and_textures(tmp_path):
  model = load_scene(painted(tmp_path)).model
  for root, geom in ((model.body("plate").id, "plate_floor"), (0, "crate")):
    rgb = geom_rgba(model)[model.geom(geom).id, :3]
    assert 'color rgba="' + " ".join(str(float(x)) for x in rgb) in write(model, root)


def test_pybullet_prints_nothing(capfd):
  pytest.importorskip("pybullet")
  bullet.connect().disconnect()
  assert capfd.readouterr() == ("", "")
