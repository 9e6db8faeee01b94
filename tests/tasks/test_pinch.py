"""The hand as tasks see it, compared with the linkage in the shipped MJCF."""

from __future__ import annotations

import dataclasses
import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import make_task
from apnpql_jax.tasks.pinch import (
  CLEARANCE,
  LOST,
  NEAR,
  STRAIGHT,
  TOLERANCE,
  Pinch,
  finger_angle,
  grip,
  is_gripping,
  is_open,
  pick_and_place,
  pinch_height,
)

FINGERS = ("finger_r1", "finger_r2", "finger_l1", "finger_l2")
GAPS = (0.005, 0.012, 0.03, 0.05, 0.075, 0.1)

WIDTH, ABOVE = 0.05, 0.004
"""m; width of the gripped object and height of the grasp in these tests."""


@pytest.fixture(scope="module")
def robot() -> mujoco.MjModel:
  return mujoco.MjModel.from_xml_path(str(mjcf_path("robot")))


def hand_at(model: mujoco.MjModel, gap: float, arm=(0.3, -1.0, 1.2, -0.4, -0.9, 0.5)):
  """Computes C MuJoCo's kinematics with the pads ``gap`` m apart."""
  data = mujoco.MjData(model)
  data.qpos[:6] = arm
  for name in FINGERS:
    data.joint(name).qpos[:] = finger_angle(gap)
  mujoco.mj_kinematics(model, data)
  return data


def pads(data: mujoco.MjData) -> np.ndarray:
  """Returns the centers of the right and left pad in the tool's frame, f64[2, 3]."""
  tool = data.site("tool")
  centers = np.stack([data.geom("r_pad").xpos, data.geom("l_pad").xpos])
  return (centers - tool.xpos) @ tool.xmat.reshape(3, 3)


@pytest.mark.parametrize("gap", GAPS)
def test_finger_angle_sets_the_distance_of_the_pads_faces(robot, gap):
  data = hand_at(robot, gap)
  right, left = pads(data)
  # The pads stay parallel to each other and across the closing direction.
  tool_mat = data.site("tool").xmat.reshape(3, 3)
  for name in ("r_pad", "l_pad"):
    turn = tool_mat.T @ data.geom(name).xmat.reshape(3, 3)
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-9)
  thickness = robot.geom("r_pad").size[1] + robot.geom("l_pad").size[1]
  assert right[1] - left[1] - thickness == pytest.approx(gap, abs=1e-6)
  np.testing.assert_allclose(right + left, [0, 0, right[2] + left[2]], atol=1e-6)


@pytest.mark.parametrize("gap", GAPS)
def test_pinch_height_is_the_distance_back_from_the_tool(robot, gap):
  right, left = pads(hand_at(robot, gap))
  assert -(right[2] + left[2]) / 2 == pytest.approx(float(pinch_height(gap)), abs=1e-6)


def test_every_gap_lies_within_the_joints_range(robot):
  low, high = robot.joint("finger_r1").range
  angles = [float(finger_angle(gap)) for gap in GAPS]
  assert low <= min(angles) and max(angles) <= high
  assert angles == sorted(angles, reverse=True)


@pytest.fixture(scope="module")
def stack_box():
  """Returns a scene; any with a robot would do."""
  return make_task("stack_box")


@pytest.fixture(scope="module")
def scene(stack_box):
  return stack_box.scene


@pytest.fixture(scope="module")
def pinch(scene) -> Pinch:
  """Grips a box of ``WIDTH``; its heading is zero in the neutral configuration."""
  data = mujoco.MjData(scene.model)
  mujoco.mj_resetDataKeyframe(scene.model, data, scene.id("key", "neutral"))
  mujoco.mj_kinematics(scene.model, data)
  mat = data.site("tool").xmat.reshape(3, 3)
  return Pinch(
    scene,
    jnp.asarray(mat, jnp.float32),
    width=WIDTH,
    above=ABOVE,
    hover=0.07,
    travel=0.14,
  )


@pytest.fixture(scope="module")
def forward(scene):
  return make_kinematics(scene)


@pytest.fixture(scope="module")
def resets(stack_box) -> physics.PhysicsState:
  draw = stack_box.sample_resets(np.random.default_rng(0), 6)
  return physics.initial_state(stack_box.scene, *map(jnp.asarray, draw))


def hands(scene, resets, gaps, wrist=0.0) -> physics.PhysicsState:
  """Returns neutral worlds with given finger gaps and offsets of the last joint."""
  qpos = np.tile(scene.keyframe("neutral"), (len(gaps), 1))
  for name in FINGERS:
    qpos[:, scene.model.joint(name).qposadr[0]] = [finger_angle(gap) for gap in gaps]
  qpos[:, scene.arm_qpos[5]] += wrist
  return resets.replace(qpos=jnp.asarray(qpos, jnp.float32))


def test_the_point_is_where_the_pads_meet_their_object(scene, resets, pinch, forward):
  """``above`` further along the tool than the pads' center, at the object's width."""
  wrist = np.linspace(-1, 1, 6)
  kinematics = forward(hands(scene, resets, [WIDTH] * 6, wrist))
  right, left = (
    kinematics.geom_xpos[:, scene.id("geom", name)] for name in ("r_pad", "l_pad")
  )
  approach = kinematics.site_xmat[:, scene.tool_site, :, 2]
  expected = (right + left) / 2 + ABOVE * approach
  np.testing.assert_allclose(pinch.point(kinematics), expected, atol=1e-5)


@pytest.mark.parametrize("period", [np.pi / 2, np.pi, 2 * np.pi])
def test_twist_is_the_hands_heading_less_the_objects(
  scene, resets, pinch, forward, period
):
  """The neutral hand points down, so that the last joint turns it in reverse."""
  wrist = np.array([-1.2, -0.3, 0.0, 0.2, 0.7, 1.5])
  kinematics = forward(hands(scene, resets, [WIDTH] * 6, wrist))
  turn = -wrist - 0.1
  folded = turn - period * np.round(turn / period)
  twist = pinch.twist(kinematics, jnp.full(6, 0.1), period)
  np.testing.assert_allclose(twist, folded, atol=1e-3)
  # At heading zero the hand closes along the world's x axis.
  closing = kinematics.site_xmat[:, scene.tool_site, :, 1]
  np.testing.assert_allclose(np.abs(closing[:, 0]), np.abs(np.cos(wrist)), atol=1e-3)


@pytest.mark.parametrize("width", [0.005, 0.09])
def test_a_width_that_the_hand_cannot_grip_is_refused(pinch, width):
  message = f"{1e3 * width:g} mm wide, only what is 6.2 to 86.9 mm"
  with pytest.raises(ConfigError, match=message):
    dataclasses.replace(pinch, width=width)


@pytest.mark.parametrize("width", [0.0064, 0.05, 0.0867])
def test_a_width_that_the_hand_can_grip_differs_from_open_and_closed_pads(
  scene, resets, pinch, width
):
  qpos = np.tile(scene.keyframe("neutral"), (2, 1))
  low, high = scene.model.joint("finger_r1").range
  qpos[:, scene.gripper_qpos] = low, high
  state = resets.replace(qpos=jnp.asarray(qpos, jnp.float32))
  hand = dataclasses.replace(pinch, width=width)
  np.testing.assert_array_equal(hand.is_open(state), [True, False])
  np.testing.assert_array_equal(is_gripping(scene, state, hand.width), [False, False])


def test_the_hand_is_open_when_the_pads_are_clear(scene, resets, pinch):
  clear = WIDTH + CLEARANCE
  state = hands(scene, resets, [0.106, clear + 1e-3, clear - 1e-3, WIDTH, 0.005, 0.03])
  np.testing.assert_array_equal(
    pinch.is_open(state), [True, True, False, False, False, False]
  )


def test_widths_may_differ_between_worlds(scene, resets):
  gaps = np.array([0.08, 0.05, 0.03, 0.02, 0.06, 0.01])
  state = hands(scene, resets, gaps)
  widths = gaps + np.array([0, 0.003, -0.003, 0.005, -0.005, -0.03])
  np.testing.assert_array_equal(
    is_gripping(scene, state, jnp.asarray(widths)), [True] * 3 + [False] * 3
  )
  spare = CLEARANCE + np.array([1e-3, -1e-3] * 3)
  np.testing.assert_array_equal(
    is_open(scene, state, jnp.asarray(gaps - spare)), [True, False] * 3
  )


def test_it_holds_objects_as_wide_as_the_gap(scene, resets, pinch, forward):
  wider = np.array([0.03, TOLERANCE + 5e-4, TOLERANCE - 5e-4, 0.0, 5e-4 - TOLERANCE])
  gaps = WIDTH + np.append(wider, -TOLERANCE - 5e-4)
  state = hands(scene, resets, gaps)
  kinematics = forward(state)
  holds = pinch.holds(state, kinematics, pinch.point(kinematics))
  np.testing.assert_array_equal(holds, [False, False, True, True, True, False])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_holds_and_closes_only_close_by(scene, resets, pinch, forward, axis):
  state = hands(scene, resets, [WIDTH] * 6)
  kinematics = forward(state)
  away = np.array([0.0, NEAR - 1e-3, NEAR + 1e-3, LOST - 1e-3, LOST + 1e-3, -0.1])
  point = pinch.point(kinematics).at[:, axis].add(away)
  np.testing.assert_array_equal(
    pinch.holds(state, kinematics, point), [True, True, True, True, False, False]
  )
  np.testing.assert_array_equal(
    pinch.around(kinematics, point, jnp.zeros(6)),
    [True, True, False, False, False, False],
  )


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_twisted_hand_may_not_close(scene, resets, pinch, forward, sign):
  kinematics = forward(hands(scene, resets, [0.1] * 6))
  twist = sign * jnp.array([0.0, 0.5, 0.9, 1.1, 2.0, 10.0]) * STRAIGHT
  around = pinch.around(kinematics, pinch.point(kinematics), twist)
  np.testing.assert_array_equal(around, [True, True, True, False, False, False])


ANY = (False, True)
RULES = (
  # around, held, done, is_open -> row of the primitives, close
  ((False,), (False,), (False,), ANY, 0, 0),  # Reach.
  ((True,), (False,), (False,), ANY, 0, 1),  # Close.
  (ANY, (True,), (False,), ANY, 1, 1),  # Carry.
  (ANY, ANY, (True,), (False,), 0, 0),  # Open, and stay meanwhile.
  (ANY, ANY, (True,), (True,), 2, 0),  # Withdraw.
)


@pytest.mark.parametrize("withdraw", [1, 2])
def test_pick_and_place_has_one_rule_for_each_case(withdraw):
  table = {case: rule[4:] for rule in RULES for case in itertools.product(*rule[:4])}
  assert len(table) == 16 == sum(np.prod([len(x) for x in rule[:4]]) for rule in RULES)
  cases = jnp.array(list(table))
  primitives = np.random.default_rng(0).normal(size=(16, 3, 7)).astype(np.float32)
  around, held, done, has_let_go = cases.T
  actions = pick_and_place(
    jnp.asarray(primitives),
    held=held,
    done=done,
    is_open=has_let_go,
    withdraw=withdraw,
  )
  commands = grip(around=around, held=held, done=done)
  for world, (row, close) in enumerate(table.values()):
    row = withdraw if row == 2 else row
    np.testing.assert_array_equal(actions[world], primitives[world, row])
    assert commands[world, row] == close
  np.testing.assert_array_equal(commands[:, 2], np.zeros(16))  # Neutral lets go.
