"""place_plate: resets, success on hand-made states, tool targets, privileged poses."""

from __future__ import annotations

import itertools

from hand_made import (
  MOTIONS,
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

from apnpql_jax.tasks import make_task, place_plate
from apnpql_jax.tasks.pinch import ALIGNED, FUNNEL, pinch_height

OPEN = 0.1
"""m between the pads."""

RADIUS, THICKNESS = place_plate.RADIUS, place_plate.THICKNESS
RIM = RADIUS - place_plate.GRASP_INSET
"""m from the plate's center to where it is gripped."""

GRASP = -float(pinch_height(THICKNESS))
"""m; height of the tool over what the pads grip."""

FLOOR = THICKNESS / 2
"""m; height of a lying plate."""


@pytest.fixture(scope="module")
def task():
  return make_task("place_plate")


def lying(steep=0.0, heading=0.0) -> Rotation:
  """Returns the rotation of a plate tilted by ``steep`` toward ``heading``."""
  return Rotation.from_euler("ZY", [heading, steep])


STANDING = lying(np.pi / 2)


def mocap(task, state, body) -> tuple[np.ndarray, Rotation]:
  index = task.scene.mocap(body)
  quat = np.asarray(state.mocap_quat[:, index], np.float64)
  where = np.asarray(state.mocap_pos[:, index], np.float64)
  return where, Rotation.from_quat(quat, scalar_first=True)


def in_box(task, state, where, turn: Rotation = STANDING):
  """Puts the plate at a pose in the box's frame."""
  origin, frame = mocap(task, state, "goal")
  return put(task, state, "plate", origin + frame.apply(where), frame * turn)


def moved(task, state, body, shift):
  index = task.scene.mocap(body)
  return state.replace(mocap_pos=state.mocap_pos.at[:, index].add(jnp.array(shift)))


def hand_at(task, state, kinematics, neutral, shift=(0.0, 0.0, 0.0), twist=0.0):
  """Puts a vertical tool at ``shift`` from its grasp of a standing plate, twisted."""
  where = (
    pos(task, state, "plate") + jnp.array([0.0, 0.0, RIM + GRASP]) + jnp.array(shift)
  )
  axis = rotation(task, state, "plate").as_matrix()[:, :, 2]
  heading = np.arctan2(axis[:, 1], axis[:, 0])[:, None]
  turn = Rotation.from_euler("z", heading + twist).as_matrix()
  return tool_at(task, kinematics, where, turn @ neutral[1])


@pytest.fixture(scope="module")
def solved(task, resets):
  """Returns worlds with the plate at rest on its edge in the middle of the box."""
  return in_box(task, resets, (0.0, 0.0, RADIUS))


@pytest.mark.parametrize(("body", "limit"), [("holder", 0.5), ("goal", 0.3)])
def test_turns_are_uniform_in_range(task, draw, body, limit):
  turn = mocap(task, draw, body)[1].as_rotvec()
  np.testing.assert_allclose(turn[:, :2], 0, atol=1e-12)
  assert_uniform(turn[:, 2], -limit, limit)


def test_the_hand_is_open(task, draw):
  start = task.scene.gripper_qpos
  assert not draw.qpos[:, start : start + 4].any()


def test_draws_are_independent(task, draw):
  turns = [mocap(task, draw, body)[1].as_rotvec() for body in ("holder", "goal")]
  turns = np.stack([turn[:, 2] for turn in turns])
  correlation = np.corrcoef(np.vstack([draw.qpos[:, task.scene.arm_qpos].T, turns]))
  np.testing.assert_allclose(correlation, np.eye(8), atol=0.07)  # Over four sigma.


def test_spots_are_uniform_among_pairs_that_are_far_apart(task, draw):
  holder, goal = (mocap(task, draw, body)[0] for body in ("holder", "goal"))
  spots = np.concatenate([holder[:, :2], goal[:, :2]], axis=1)
  assert not holder[:, 2].any() and not goal[:, 2].any()
  low, high = np.array(place_plate.WORKSPACE).T
  least = place_plate.MIN_DISTANCE
  assert_pairs_are_uniform(spots, low, high, distance=apart, least=least)


def test_the_plate_stands_in_the_middle_of_its_holder(task, draw):
  spot, frame = mocap(task, draw, "holder")
  height = task.scene.keyframe("neutral")[task.scene.free_joint("plate")[0] + 2]
  assert height == pytest.approx(RADIUS, abs=1e-4)
  np.testing.assert_allclose(
    pos(task, draw, "plate"), spot + [0, 0, height], atol=1e-12
  )
  # The jaws are opposite each other on the holder's x axis.
  axis = frame.inv().apply(rotation(task, draw, "plate").as_matrix()[:, :, 2])
  np.testing.assert_allclose(axis, np.tile([1, 0, 0], (len(axis), 1)), atol=1e-6)


def test_the_plate_touches_neither_jaws_nor_walls(task, draw):
  model = task.scene.model
  data = mujoco.MjData(model)
  jaws = ("jaw_0", "jaw_1")
  walls = [f"wall_{i}" for i in range(4)]

  def nearest(ones, others):
    pairs = itertools.product(ones, others)
    ids = [[model.geom(name).id for name in pair] for pair in pairs]
    return min(mujoco.mj_geomDistance(model, data, *x, 1.0, None) for x in ids)

  for qpos, mocap_pos, mocap_quat, *_ in zip(*(x[:100] for x in draw), strict=True):
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, mocap_pos, mocap_quat
    mujoco.mj_forward(model, data)
    # Two millimeters on both sides.
    for jaw in jaws:
      assert nearest([jaw], ["plate"]) == pytest.approx(0.002, abs=1e-5)
    assert nearest(walls, ["plate", *jaws]) > 0


def judge(task, state, kinematics) -> np.ndarray:
  return np.asarray(task.success(state, kinematics))


LEAN = np.array([0.0, 0.0, RADIUS * np.sin(1.0) + FLOOR * np.cos(1.0)])


@pytest.mark.parametrize(
  ("turn", "where"),
  [
    (STANDING, (0.0, 0.0, RADIUS)),
    (lying(np.pi / 2, 1.5), (0.0, 0.0, RADIUS)),
    (lying(), (0.0, 0.0, FLOOR)),
    (lying(np.pi, 0.4), (0.0, 0.0, FLOOR)),
    (lying(1.0), LEAN),
    (lying(-1.0, 2.0), LEAN),
    (lying(np.pi - 1.0, -1.0), LEAN),
  ],
)
def test_a_plate_in_the_box_is_success(task, resets, kinematics, turn, where):
  """On its edge, on either side, or leaning."""
  assert judge(task, in_box(task, resets, where, turn), kinematics).all()


@pytest.mark.parametrize("turn", [STANDING, lying(), lying(np.pi)])
@pytest.mark.parametrize(
  ("x", "y", "expected"),
  [
    (0.119, 0.0, True),
    (0.121, 0.0, False),
    (-0.119, 0.0, True),
    (-0.121, 0.0, False),
    (0.0, 0.084, True),
    (0.0, 0.086, False),
    (0.0, -0.086, False),
    (0.119, -0.084, True),
    (0.119, -0.086, False),
    (0.3, 0.0, False),
  ],
)
def test_its_center_must_be_between_the_walls(
  task, resets, kinematics, turn, x, y, expected
):
  height = RADIUS if turn is STANDING else FLOOR
  state = in_box(task, resets, (x, y, height), turn)
  assert (judge(task, state, kinematics) == expected).all()


@pytest.mark.parametrize(
  ("turn", "where", "expected"),
  [
    (STANDING, (0.0, 0.0, RADIUS + 0.011), True),
    (STANDING, (0.0, 0.0, RADIUS + 0.013), False),
    (STANDING, (0.0, 0.0, RADIUS + place_plate.LIFT), False),  # Held over the box.
    (lying(1.0), LEAN + [0.0, 0.0, 0.011], True),
    (lying(1.0), LEAN + [0.0, 0.0, 0.013], False),
    (lying(), (0.0, 0.0, FLOOR + 0.011), True),
    (lying(), (0.0, 0.0, FLOOR + 0.013), False),  # Held, lying.
    (lying(), (0.11, 0.0, 0.04 + FLOOR), False),  # On top of a wall.
    (STANDING, (0.0, 0.08, 0.04 + RADIUS), False),
    (lying(np.pi / 4), (0.151, 0.0, RADIUS * np.sqrt(0.5)), False),  # Leans from out.
  ],
)
def test_it_must_be_on_the_floor_of_the_box(
  task, resets, kinematics, turn, where, expected
):
  state = in_box(task, resets, where, turn)
  assert (judge(task, state, kinematics) == expected).all()


def test_the_goal_is_where_the_box_is(task, resets, solved, kinematics):
  """The goal is not a fixed place, and not the holder."""
  assert not judge(task, moved(task, solved, "goal", (0.2, 0, 0)), kinematics).any()
  assert judge(task, moved(task, solved, "holder", (0.2, 0, 0)), kinematics).all()
  origin, frame = mocap(task, resets, "holder")
  flat = put(task, resets, "plate", origin + [0, 0, FLOOR], frame)
  assert not judge(task, flat, kinematics).any()


@pytest.mark.parametrize(("dof", "speed", "rests"), MOTIONS)
def test_a_moving_plate_is_not_success(task, solved, kinematics, dof, speed, rests):
  state = moving(task, solved, "plate", dof, speed)
  assert (judge(task, state, kinematics) == rests).all()


@pytest.mark.parametrize("turn", [STANDING, lying(1.2)])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
  ("distance", "expected"), [(0.0, False), (RIM, False), (0.101, False), (0.103, True)]
)
def test_the_hand_must_be_away(
  task, resets, kinematics, neutral, turn, axis, distance, expected
):
  """It must be 5 cm outside the circle of grasps, in any direction."""
  tilt = turn.as_matrix()[2, 2]
  height = RADIUS * np.sqrt(1 - tilt**2)
  state = in_box(task, resets, (0.0, 0.0, height), turn)
  tool = pos(task, state, "plate").at[:, 2].add(GRASP).at[:, axis].add(distance)
  hand = tool_at(task, kinematics, tool, neutral[1])
  assert (judge(task, state, hand) == expected).all()


def test_a_plate_in_the_hand_is_not_success(task, solved, kinematics, neutral):
  held = with_gap(task, solved, THICKNESS)
  assert not judge(task, held, hand_at(task, held, kinematics, neutral)).any()


@pytest.mark.parametrize("steep", [np.pi / 2, np.pi / 2 - 0.4])
@pytest.mark.parametrize("drop", [0.005, 0.015])
def test_a_plate_let_go_in_the_box_stays_in_it(
  task, resets, kinematics, rest, steep, drop
):
  """On its edge, or falling over along the longer side; solved when it has landed."""
  height = RADIUS * np.sin(steep) + THICKNESS / 2 * np.cos(steep) + drop
  state = in_box(task, resets, (0.0, 0.0, height), lying(steep))
  assert (judge(task, state, kinematics) == (drop < place_plate.ON_FLOOR)).all()
  assert judge(task, rest(state), kinematics).all()


def test_a_plate_dropped_on_a_wall_does_not_count(task, resets, kinematics, rest):
  """It comes to rest outside, or leans on the wall with its center above it."""
  state = rest(in_box(task, resets, (0.20, 0.0, 0.08), lying()))
  assert not judge(task, state, kinematics).any()


def edge(task, state):
  """Finds the highest point of a circle just inside the plate's edge."""
  mat = rotation(task, state, "plate").as_matrix()
  angle = np.linspace(0, 2 * np.pi, 20001)
  circle = RIM * np.stack([np.cos(angle), np.sin(angle), 0 * angle])
  highest = (mat[:, 2] @ circle).argmax(-1)
  return pos(task, state, "plate") + jnp.asarray(
    (mat @ circle)[np.arange(len(mat)), :, highest], jnp.float32
  )


FUNNEL_WIDTH = FUNNEL - ALIGNED


@pytest.mark.parametrize(
  ("shift", "gap", "twist", "funnel"),
  [
    # High and away: above the plate. In the funnel: lower. Aligned: down.
    ((0.10, 0.0, 0.15), OPEN, 0.0, 1.0),
    ((0.0, -0.031, 0.15), OPEN, 0.0, 0.5),
    ((0.031, 0.0, 0.02), OPEN, 0.0, 0.5),
    ((-0.01, 0.0, 0.07), OPEN, 0.0, 0.0),
    ((0.0, 0.0, 0.0), OPEN, 0.0, 0.0),
    # A twist keeps the hand up, apart from the first 0.06 rad.
    ((0.0, 0.0, 0.07), OPEN, 0.5, (0.05 * 0.44 - 0.012) / FUNNEL_WIDTH),
    ((0.0, 0.02, 0.07), OPEN, -0.3, (0.02 + 0.05 * 0.24 - 0.012) / FUNNEL_WIDTH),
    ((0.0, 0.0, 0.07), OPEN, 0.5 * np.pi, 1.0),
    ((0.0, 0.0, 0.07), OPEN, -np.pi, 0.0),
    # Fingers closed on nothing do not descend.
    ((0.0, 0.0, 0.05), 0.025, 0.0, 1.0),
    ((0.0, 0.0, 0.05), THICKNESS, 0.0, 1.0),
    # Fingers that close around the plate stay, unless they are twisted.
    ((0.0, 0.0, 0.005), 0.025, 0.05, 0.0),
    ((0.0, 0.0, 0.0), 0.025, 0.2, 1.0),
    # So do those that hold it, even after a slip of 2 cm.
    ((0.0, 0.0, 0.0), THICKNESS, 0.0, 0.0),
    ((0.0, 0.02, 0.0), THICKNESS, 0.0, 0.008 / FUNNEL_WIDTH),
    ((0.0, 0.03, 0.0), THICKNESS, 0.0, 1.0),
  ],
)
def test_object_target(task, resets, kinematics, neutral, shift, gap, twist, funnel):
  state = with_gap(task, resets, gap)
  hand = hand_at(task, state, kinematics, neutral, shift, twist)
  positions, *_ = task.tool_targets(state, hand)
  height = RIM + GRASP + place_plate.HOVER * funnel
  expected = pos(task, state, "plate") + jnp.array([0.0, 0.0, height])
  np.testing.assert_allclose(positions[:, 0], expected, atol=1e-5)


@pytest.mark.parametrize("steep", [0.2, 0.8, 1.3, np.pi / 2, 2.5, -1.0])
@pytest.mark.parametrize("heading", [0.0, 0.9, -2.8])
def test_a_leaning_plate_is_gripped_at_its_highest_edge(
  task, resets, kinematics, neutral, steep, heading
):
  state = put(task, resets, "plate", pos(task, resets, "plate"), lying(steep, heading))
  tool = edge(task, state).at[:, 2].add(GRASP)
  turn = Rotation.from_euler("z", heading).as_matrix()
  hand = tool_at(task, kinematics, tool, turn @ neutral[1])
  positions, rotations, _ = task.tool_targets(state, hand)
  np.testing.assert_allclose(positions[:, 0], tool, atol=3e-5)
  # The hand is already across the plate, up to half a turn.
  closing = np.asarray(rotations[:, 0, :, 1]) @ (turn @ neutral[1])[:, 1]
  np.testing.assert_allclose(np.abs(closing), 1, atol=1e-4)


@pytest.mark.parametrize("steep", [0.0, 1e-4, np.pi])
def test_a_lying_plate_has_its_middle_as_target(task, resets, kinematics, steep):
  """It has no highest edge; the target must not jump and must be finite."""
  state = put(task, resets, "plate", turn=lying(steep))
  high = tool_at(task, kinematics, jnp.array([0.5, 0.0, 0.3]))
  positions, rotations, _ = task.tool_targets(state, high)
  np.testing.assert_allclose(
    positions[:, 0, :2], pos(task, state, "plate")[:, :2], atol=1e-4
  )
  assert np.isfinite(positions).all() and np.isfinite(rotations).all()


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize("gap", [OPEN, 0.02, THICKNESS])
@pytest.mark.parametrize(
  ("off", "height", "rises"),
  [
    (0.08, 0.05, True),
    (-0.051, 0.05, True),
    (0.08, 0.199, True),
    (0.08, 0.201, False),
    (0.049, 0.05, False),
  ],
)
def test_a_low_tool_that_is_away_rises(
  task, resets, kinematics, row, gap, off, height, rises
):
  over = jnp.asarray(mocap(task, resets, "holder" if row == 0 else "goal")[0])
  tool = over.at[:, 0].add(off).at[:, 2].set(height)
  state = with_gap(task, resets, gap)
  positions, *_ = task.tool_targets(state, tool_at(task, kinematics, tool))
  expected = tool if rises else over
  np.testing.assert_allclose(positions[:, row, :2], expected[:, :2], atol=1e-6)
  if rises or row == 1:
    np.testing.assert_allclose(positions[:, row, 2], place_plate.TRAVEL, rtol=1e-6)


@pytest.mark.parametrize(
  ("away", "height", "free", "far"),
  [
    # In its holder only up; sideways with increasing height.
    (0.3, 0.0, 0.0, 1.0),
    (0.3, 0.005, 0.0, 1.0),
    (0.3, 0.0225, 0.5, 1.0),
    (0.3, 0.04, 1.0, 1.0),
    (-0.2, 0.1, 1.0, 1.0),
    # Lower near its place, where it may be low.
    (0.028, 0.0425, 1.0, 0.5),
    (0.028, 0.0, 0.5, 0.5),
    (0.005, 0.04, 1.0, 0.0),
    (0.005, 0.0, 1.0, 0.0),
  ],
)
@pytest.mark.parametrize("slip", [0.0, -0.02])
def test_a_held_plate_is_carried_into_the_box(
  task, resets, kinematics, neutral, away, height, free, far, slip
):
  """The plate, not the tool, reaches the goal, finally 3 mm above the floor."""
  goal, frame = mocap(task, resets, "goal")
  start = goal + [0.0, away, RADIUS + height]
  state = with_gap(task, put(task, resets, "plate", start), THICKNESS)
  hand = hand_at(task, state, kinematics, neutral, (0.0, slip, 0.0))
  positions, rotations, _ = task.tool_targets(state, hand)
  step = positions[:, 1] - hand.site_xpos[:, task.scene.tool_site]
  expected = start + free * (goal - start)
  expected[:, 2] = RADIUS + 0.003 + place_plate.LIFT * far
  np.testing.assert_allclose(start + step, expected, atol=1e-5)
  # A plate is turned across the box only once it is free.
  plate = rotation(task, state, "plate").as_matrix()[:, :, 2]
  axis = frame.as_matrix()[:, :, 0] if free == 1 else plate
  closing = np.asarray(rotations[:, 1, :, 1])
  np.testing.assert_allclose(np.abs((closing * axis).sum(-1)), 1, atol=1e-4)


def test_an_empty_hand_goes_above_the_box(task, resets, kinematics):
  high = tool_at(task, kinematics, jnp.array([0.5, 0.0, 0.3]))
  positions, rotations, _ = task.tool_targets(resets, high)
  goal, frame = mocap(task, resets, "goal")
  expected = goal + [0.0, 0.0, place_plate.TRAVEL]
  np.testing.assert_allclose(positions[:, 1], expected, atol=1e-6)
  closing = frame.inv().apply(np.asarray(rotations[:, 1, :, 1]))
  np.testing.assert_allclose(np.abs(closing[:, 0]), 1, atol=1e-4)


@pytest.mark.parametrize("heading", [0.0, 1.4, 1.8, -2.5, 3.0])
def test_the_fingers_close_across_the_plate(task, resets, kinematics, neutral, heading):
  """Of two ways the one nearer to neutral; the tool points down."""
  state = put(
    task, resets, "plate", pos(task, resets, "plate"), lying(np.pi / 2, heading)
  )
  target = np.asarray(task.tool_targets(state, kinematics)[1])[:, 0]
  np.testing.assert_allclose(target[:, 2, 2], -1, atol=1e-3)
  axis = rotation(task, state, "plate").as_matrix()[:, :, 2]
  closing = (target[:, :, 1] * axis).sum(-1)
  np.testing.assert_allclose(np.abs(closing), 1, atol=1e-4)
  turned = Rotation.from_matrix(target) * Rotation.from_matrix(neutral[1]).inv()
  assert (turned.magnitude() < np.pi / 2 + 1e-3).all()


@pytest.mark.parametrize(
  "turn", [STANDING, lying(), lying(np.pi), Rotation.from_euler("zyx", [1, 2, 3])]
)
def test_objects_are_the_poses_of_plate_and_box(task, resets, turn):
  state = in_box(task, resets, (0.01, 0.02, 0.3), turn)
  goal, frame = mocap(task, state, "goal")
  plate = goal + frame.apply([0.01, 0.02, 0.3])
  axis, side = (frame * turn).as_matrix()[:, :, 2], frame.as_matrix()[:, :, 0]
  expected = [plate, plate + 0.2 * axis, goal, goal + 0.2 * side]
  np.testing.assert_allclose(task.objects(state), np.hstack(expected), atol=1e-6)


@pytest.mark.parametrize(
  ("place", "gap", "lift", "row", "close"),
  [
    (None, OPEN, 0.1, 0, 0),  # Reach.
    (None, OPEN, 0.0, 0, 1),  # Close.
    (None, THICKNESS, 0.0, 1, 1),  # Carry.
    ((0.0, 0.0, RADIUS + 0.05), THICKNESS, 0.0, 1, 1),
    ((0.0, 0.0, RADIUS + 0.005), THICKNESS, 0.0, 0, 0),  # Let go.
    ((0.0, 0.0, RADIUS), OPEN, 0.0, 2, 0),  # Withdraw.
  ],
)
def test_the_expert_picks_and_places(
  task, resets, kinematics, neutral, place, gap, lift, row, close
):
  state = with_gap(task, resets, gap)
  if place is not None:
    state = in_box(task, state, place)
  hand = hand_at(task, state, kinematics, neutral, (0.0, 0.0, lift))
  primitives = jnp.arange(WORLDS * 21.0).reshape(WORLDS, 3, 7)
  action = task.expert(state, hand, primitives)
  np.testing.assert_array_equal(action, primitives[:, row])
  commands = task.tool_targets(state, hand)[2]
  np.testing.assert_array_equal(commands[:, row], np.full(WORLDS, close))
