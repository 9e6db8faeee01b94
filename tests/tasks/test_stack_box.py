"""stack_box: resets, success on hand-made states, tool targets, privileged poses."""

from __future__ import annotations

from hand_made import (
  MOTIONS,
  SLOW_MJX,
  WORLDS,
  apart,
  assert_pairs_are_uniform,
  assert_uniform,
  moving,
  pos,
  put,
  rotation,
  tool_at,
  with_gap,
)
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.tasks import make_task, stack_box
from apnpql_jax.tasks.pinch import ALIGNED, FUNNEL, pinch_height

OPEN = 0.1
"""m between the pads."""

GRASP = 0.004 - float(pinch_height(stack_box.SIDE))
"""m; height of the tool over the box's center when the pads are 4 mm above it."""

ON_BLUE = (0.0, 0.0, stack_box.SIDE)


@pytest.fixture(scope="module")
def task():
  return make_task("stack_box")


@pytest.fixture(scope="module")
def solved(task, resets):
  """Returns worlds with the yellow box at rest exactly on the blue one."""
  return put(task, resets, "yellow", pos(task, resets, "blue") + jnp.array(ON_BLUE))


def moved(task, state, body, shift):
  return put(task, state, body, pos(task, state, body) + jnp.array(shift))


def turned(task, state, body, turn: Rotation):
  """Turns a box about its own axes."""
  return put(task, state, body, turn=rotation(task, state, body) * turn)


def hand_at(task, state, kinematics, neutral, shift, twist=0.0):
  """Puts a vertical tool at ``shift`` from its grasp of yellow, twisted."""
  where = pos(task, state, "yellow") + jnp.array([0.0, 0.0, GRASP]) + jnp.array(shift)
  heading = rotation(task, state, "yellow").as_euler("ZYX")[:, :1]
  turn = Rotation.from_euler("z", heading + twist).as_matrix()
  return tool_at(task, kinematics, where, turn @ neutral[1])


def test_turns_are_uniform_in_range(task, draw):
  for body in ("yellow", "blue"):
    turn = rotation(task, draw, body).as_rotvec()
    np.testing.assert_allclose(turn[:, :2], 0, atol=1e-12)
    assert_uniform(turn[:, 2], -stack_box.MAX_YAW, stack_box.MAX_YAW)


def test_draws_are_independent(task, draw):
  turns = [rotation(task, draw, body).as_rotvec() for body in ("yellow", "blue")]
  turns = np.stack([turn[:, 2] for turn in turns])
  correlation = np.corrcoef(np.vstack([draw.qpos[:, task.scene.arm_qpos].T, turns]))
  np.testing.assert_allclose(correlation, np.eye(8), atol=0.07)  # Over four sigma.


def test_spots_are_uniform_among_pairs_that_are_far_apart(task, draw):
  spots = np.hstack(
    [draw.qpos[:, a : a + 2] for a, _ in map(task.scene.free_joint, ("yellow", "blue"))]
  )
  low, high = np.array(stack_box.WORKSPACE).T
  least = stack_box.MIN_DISTANCE
  assert_pairs_are_uniform(spots, low, high, distance=apart, least=least)


def test_everything_else_in_a_reset_is_the_keyframe(task, draw):
  varied = list(task.scene.arm_qpos)
  for body in ("yellow", "blue"):
    address, _ = task.scene.free_joint(body)
    varied += [address, address + 1, *range(address + 3, address + 7)]
  neutral = np.delete(task.scene.keyframe("neutral"), varied)
  rest = np.delete(draw.qpos, varied, axis=1)
  np.testing.assert_array_equal(rest, np.broadcast_to(neutral, rest.shape))


def test_the_boxes_stand_apart_on_the_table(task, draw):
  model = task.scene.model
  data = mujoco.MjData(model)

  def distance(one, other):
    ids = (model.geom(name).id for name in (one, other))
    return mujoco.mj_geomDistance(model, data, *ids, 1.0, None)

  for qpos in draw.qpos[:200]:
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    assert distance("yellow", "blue") > 0.05
    for box in ("yellow", "blue"):
      assert abs(distance("table", box)) < 1e-6


def judge(task, state, kinematics) -> np.ndarray:
  return np.asarray(task.success(state, kinematics))


def test_yellow_at_rest_on_blue_is_success(task, solved, kinematics):
  assert judge(task, solved, kinematics).all()


@pytest.mark.parametrize(
  ("shift", "expected"),
  [
    ((0.019, 0.0, 0.0), True),
    ((0.021, 0.0, 0.0), False),
    ((0.0, -0.019, 0.0), True),
    ((0.0, -0.021, 0.0), False),
    ((-0.013, 0.013, 0.0), True),
    ((-0.015, 0.015, 0.0), False),  # Round, not square.
    ((0.0, 0.0, 0.004), True),
    ((0.0, 0.0, 0.006), False),
    ((0.0, 0.0, -0.004), True),
    ((0.0, 0.0, -0.006), False),
    ((0.0, 0.0, 0.1), False),  # Held in the air.
    ((0.05, 0.0, -0.05), False),  # Next to the blue box.
    ((0.0, 0.0, -0.1), False),  # Below it.
  ],
)
def test_yellow_must_be_on_blue(task, solved, kinematics, shift, expected):
  state = moved(task, solved, "yellow", shift)
  assert (judge(task, state, kinematics) == expected).all()


@pytest.mark.parametrize(
  ("height", "expected"), [(0.004, True), (0.006, False), (0.2, False)]
)
def test_blue_must_be_on_the_table(task, solved, kinematics, height, expected):
  for body in ("yellow", "blue"):
    solved = moved(task, solved, body, (0.0, 0.0, height))
  assert (judge(task, solved, kinematics) == expected).all()


def test_blue_on_yellow_is_not_success(task, resets, kinematics):
  state = put(task, resets, "blue", pos(task, resets, "yellow") + jnp.array(ON_BLUE))
  assert not judge(task, state, kinematics).any()


def test_the_stack_may_move_as_a_whole(task, solved, kinematics):
  pushed = moved(task, solved, "blue", (0.06, -0.03, 0.0))
  assert not judge(task, pushed, kinematics).any()
  together = moved(task, pushed, "yellow", (0.06, -0.03, 0.0))
  assert judge(task, together, kinematics).all()


@pytest.mark.parametrize("body", ["yellow", "blue"])
@pytest.mark.parametrize(
  ("axis", "angle"), [("x", np.pi), ("y", np.pi / 2), ("x", -np.pi / 2), ("z", 0.8)]
)
def test_a_box_may_lie_on_any_face(task, solved, kinematics, body, axis, angle):
  """All faces look the same."""
  state = turned(task, solved, body, Rotation.from_euler(axis, angle))
  assert judge(task, state, kinematics).all()


@pytest.mark.parametrize("angle", [0.35, np.pi / 4])
def test_a_tipped_yellow_box_is_not_success(task, solved, kinematics, angle):
  """It stands on an edge, which raises its center."""
  height = stack_box.SIDE / 2 * (np.cos(angle) + np.sin(angle) - 1)
  state = turned(task, solved, "yellow", Rotation.from_euler("y", angle))
  state = moved(task, state, "yellow", (0.0, 0.0, height))
  assert not judge(task, state, kinematics).any()


@pytest.mark.parametrize("body", ["yellow", "blue"])
@pytest.mark.parametrize(("dof", "speed", "rests"), MOTIONS)
def test_both_boxes_must_be_at_rest(task, solved, kinematics, body, dof, speed, rests):
  state = moving(task, solved, body, dof, speed)
  assert (judge(task, state, kinematics) == rests).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
  ("distance", "expected"), [(0.0, False), (0.049, False), (0.051, True)]
)
def test_the_hand_must_be_away(task, solved, kinematics, axis, distance, expected):
  tool = pos(task, solved, "yellow").at[:, axis].add(distance)
  state = judge(task, solved, tool_at(task, kinematics, tool))
  assert (state == expected).all()


def test_a_box_in_the_hand_is_not_success(task, solved, kinematics, neutral):
  held = with_gap(task, solved, stack_box.SIDE)
  hand = hand_at(task, held, kinematics, neutral, (0.0, 0.0, 0.0))
  assert not judge(task, held, hand).any()


def test_a_stack_at_the_tolerance_stands(task, solved, kinematics, rest):
  """A solved state remains solved."""
  state = moved(task, solved, "yellow", (0.0, 0.019, 0.0))
  assert judge(task, rest(state), kinematics).all()


@pytest.mark.parametrize("rest", SLOW_MJX, indirect=True, scope="module")
@pytest.mark.parametrize(
  ("off", "stands"), [(0.005, True), (0.01, True), (0.03, False)]
)
def test_a_dropped_box_counts_when_it_has_landed(
  task, solved, kinematics, rest, off, stands
):
  """It falls from 2 cm, over the blue box or beyond its edge.

  With 20 iterations of its line search C MuJoCo throws every other box.
  """
  state = moved(task, solved, "yellow", (0.0, off, 0.02))
  assert not judge(task, state, kinematics).any()
  assert (judge(task, rest(state), kinematics) == stands).all()


FUNNEL_WIDTH = FUNNEL - ALIGNED


@pytest.mark.parametrize(
  ("shift", "gap", "twist", "funnel"),
  [
    # High and away: above the box. In the funnel: lower. Aligned: down.
    ((0.10, 0.0, 0.15), OPEN, 0.0, 1.0),
    ((0.0, -0.031, 0.15), OPEN, 0.0, 0.5),
    ((0.031, 0.0, 0.02), OPEN, 0.0, 0.5),
    ((-0.01, 0.0, 0.07), OPEN, 0.0, 0.0),
    ((0.0, 0.0, 0.0), OPEN, 0.0, 0.0),
    # A twist keeps the hand up, apart from the first 0.125 rad.
    ((0.0, 0.0, 0.07), OPEN, 0.12, 0.0),
    ((0.0, 0.0, 0.07), OPEN, 0.6, (0.05 * 0.475 - 0.012) / FUNNEL_WIDTH),
    ((0.0, 0.02, 0.07), OPEN, -0.3, (0.02 + 0.05 * 0.175 - 0.012) / FUNNEL_WIDTH),
    ((0.0, 0.0, 0.07), OPEN, 1.5 * np.pi, 0.0),
    # Fingers closed on nothing do not descend.
    ((0.0, 0.0, 0.07), 0.02, 0.0, 1.0),
    ((0.0, 0.0, 0.07), 0.07, 0.0, 1.0),
    # Fingers that close around the box stay, unless they are twisted.
    ((0.0, 0.0, 0.005), 0.07, 0.05, 0.0),
    ((0.0, 0.0, 0.0), 0.07, 0.2, 0.0),
    ((0.0, 0.0, 0.0), 0.07, 0.3, 1.0),
    # So do those that hold it, even after a slip of 2 cm.
    ((0.0, 0.0, 0.0), stack_box.SIDE, 0.0, 0.0),
    ((0.02, 0.0, 0.0), stack_box.SIDE, 0.0, 0.008 / FUNNEL_WIDTH),
    ((0.03, 0.0, 0.0), stack_box.SIDE, 0.0, 1.0),
  ],
)
def test_object_target(task, resets, kinematics, neutral, shift, gap, twist, funnel):
  state = with_gap(task, resets, gap)
  hand = hand_at(task, state, kinematics, neutral, shift, twist)
  positions, *_ = task.tool_targets(state, hand)
  height = GRASP + stack_box.HOVER * funnel
  expected = pos(task, state, "yellow") + jnp.array([0.0, 0.0, height])
  np.testing.assert_allclose(positions[:, 0], expected, atol=1e-5)


@pytest.mark.parametrize(("row", "body"), [(0, "yellow"), (1, "blue")])
@pytest.mark.parametrize("gap", [OPEN, 0.02, stack_box.SIDE])
@pytest.mark.parametrize(
  ("off", "height", "rises"),
  [
    (0.08, 0.03, True),
    (0.051, 0.03, True),
    (0.08, 0.119, True),
    (0.08, 0.121, False),
    (0.049, 0.03, False),
  ],
)
def test_a_low_tool_that_is_away_rises(
  task, resets, kinematics, row, body, gap, off, height, rises
):
  """The offset is along x, and smaller than the distance of the boxes."""
  tool = pos(task, resets, body).at[:, 0].add(off).at[:, 2].set(height)
  state = with_gap(task, resets, gap)
  positions, *_ = task.tool_targets(state, tool_at(task, kinematics, tool))
  over = tool if rises else pos(task, resets, body)
  np.testing.assert_allclose(positions[:, row, :2], over[:, :2], atol=1e-6)
  if rises or body == "blue":
    np.testing.assert_allclose(positions[:, row, 2], stack_box.TRAVEL, rtol=1e-6)


def test_an_empty_hand_goes_above_the_goal(task, resets, kinematics, neutral):
  high = tool_at(task, kinematics, jnp.array([0.5, 0.0, 0.3]))
  positions, rotations, _ = task.tool_targets(resets, high)
  straight = np.broadcast_to(neutral[1], (WORLDS, 3, 3))
  np.testing.assert_allclose(rotations[:, 1], straight, atol=1e-5)
  blue = pos(task, resets, "blue")
  expected = blue.at[:, 2].set(stack_box.TRAVEL)
  np.testing.assert_allclose(positions[:, 1], expected, atol=1e-6)


@pytest.mark.parametrize(
  ("shift", "lift"),
  [
    ((0.15, 0.0, 0.0), 1.0),
    ((0.0, -0.3, 0.1), 1.0),
    ((0.028, 0.0, 0.1), 0.5),
    ((0.0, 0.005, 0.08), 0.0),
    ((0.0, 0.0, 0.05), 0.0),
  ],
)
@pytest.mark.parametrize("slip", [0.0, 0.02])
def test_a_held_box_is_carried_onto_the_blue_one(
  task, resets, kinematics, neutral, shift, lift, slip
):
  """The box, not the tool, reaches the goal, finally 1 mm above the blue one."""
  blue = pos(task, resets, "blue")
  state = put(task, resets, "yellow", blue + jnp.array(shift))
  state = with_gap(task, state, stack_box.SIDE)
  hand = hand_at(task, state, kinematics, neutral, (slip, 0.0, 0.0))
  positions, rotations, _ = task.tool_targets(state, hand)
  step = positions[:, 1] - hand.site_xpos[:, task.scene.tool_site]
  height = stack_box.SIDE + 0.001 + stack_box.LIFT * lift
  expected = blue + jnp.array([0.0, 0.0, height])
  np.testing.assert_allclose(pos(task, state, "yellow") + step, expected, atol=1e-5)
  # It is not turned on the way.
  here = hand.site_xmat[:, task.scene.tool_site]
  np.testing.assert_allclose(rotations[:, 1], here, atol=1e-5)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5, -2.0])
def test_the_fingers_close_on_faces(task, resets, kinematics, neutral, turn):
  """Of four ways the one nearest to neutral; the tool points down."""
  state = turned(task, resets, "yellow", Rotation.from_euler("z", turn))
  target = np.asarray(task.tool_targets(state, kinematics)[1])[:, 0]
  np.testing.assert_allclose(target[:, 2, 2], -1, atol=1e-3)
  face = rotation(task, state, "yellow").inv().apply(target[:, :, 1])
  np.testing.assert_allclose(np.abs(face).max(-1), 1, atol=1e-4)
  difference = Rotation.from_matrix(target) * Rotation.from_matrix(neutral[1]).inv()
  assert (difference.magnitude() < np.pi / 4 + 1e-3).all()


def faces(task, state, body) -> np.ndarray:
  """Returns the center and a point 0.2 m along the axis nearest to the world's x."""
  mat = rotation(task, state, body).as_matrix()
  normals = np.concatenate([mat, -mat], axis=-1)  # f64[n, 3, 6]
  nearest = normals[:, 0].argmax(-1)
  normal = normals[np.arange(len(mat)), :, nearest]
  center = np.asarray(pos(task, state, body), np.float64)
  return np.concatenate([center, center + 0.2 * normal], -1)


@pytest.mark.parametrize(
  "face", [("x", 0.0), ("x", np.pi), ("x", 1.5707), ("y", 1.5707), ("y", -1.5709)]
)
@pytest.mark.parametrize("turn", [0.0, 0.7, 1.2, 2.9, -2.0])
def test_objects_are_the_boxes_and_their_faces(task, resets, turn, face):
  """On any face, and not exactly flat."""
  state = resets
  for body in ("yellow", "blue"):
    lying = Rotation.from_euler("z", turn) * Rotation.from_euler(*face)
    state = turned(task, state, body, lying)
  state = moved(task, state, "yellow", (0.01, 0.02, 0.03))
  expected = [faces(task, state, body) for body in ("yellow", "blue")]
  np.testing.assert_allclose(task.objects(state), np.hstack(expected), atol=4e-5)


@pytest.mark.parametrize(
  ("place", "gap", "lift", "row", "close"),
  [
    ("table", OPEN, 0.1, 0, 0),  # Reach.
    ("table", OPEN, 0.0, 0, 1),  # Close.
    ("table", stack_box.SIDE, 0.0, 1, 1),  # Carry.
    ("blue", stack_box.SIDE, 0.0, 0, 0),  # Let go.
    ("blue", OPEN, 0.0, 2, 0),  # Withdraw.
    ("blue's edge", stack_box.SIDE, 0.0, 1, 1),  # Too far off to let go.
  ],
)
def test_the_expert_picks_and_places(
  task, resets, kinematics, neutral, place, gap, lift, row, close
):
  if place != "table":
    edge = 0.015 if place == "blue's edge" else 0.0
    on_blue = pos(task, resets, "blue") + jnp.array(ON_BLUE).at[0].add(edge)
    resets = put(task, resets, "yellow", on_blue)
  state = with_gap(task, resets, gap)
  hand = hand_at(task, state, kinematics, neutral, (0.0, 0.0, lift))
  primitives = jnp.arange(WORLDS * 21.0).reshape(WORLDS, 3, 7)
  action = task.expert(state, hand, primitives)
  np.testing.assert_array_equal(action, primitives[:, row])
  commands = task.tool_targets(state, hand)[2]
  np.testing.assert_array_equal(commands[:, row], np.full(WORLDS, close))
