"""flip_cup: resets, success on hand-made states, tool targets during a flip."""

from __future__ import annotations

from hand_made import (
  MOTIONS,
  WORLDS,
  assert_pairs_are_uniform,
  assert_uniform,
  each_cup,
  moving,
  pos,
  put,
  rotation,
  segmentation,
  tool_at,
  with_gap,
)
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import flip_cup, make_task
from apnpql_jax.tasks.pinch import ALIGNED, FUNNEL, pinch_height

UPRIGHT = Rotation.identity()
UPSIDE_DOWN = Rotation.from_euler("x", np.pi)
OPEN = 0.1
"""m between the pads."""


@pytest.fixture(scope="module")
def task():
  return make_task("flip_cup")


@pytest.fixture(scope="module")
def cups(task):
  return each_cup(task, WORLDS)


@pytest.fixture(scope="module")
def resets(cups):
  """Returns initial states with the three shapes in turn."""
  return cups[0]


@pytest.fixture(scope="module")
def half(cups) -> np.ndarray:
  """Returns half the width and half the height of each cup, f64[WORLDS, 2], m."""
  return cups[1]


@pytest.fixture(scope="module")
def solved(task, resets, half):
  return on_goal(task, resets, half[:, 1])


def on_goal(task, state, height, shift=(0.0, 0.0, 0.0), turn=UPRIGHT):
  """Puts the cup's center ``height`` above the goal, plus ``shift``."""
  goal = np.asarray(state.mocap_pos[:, task.scene.mocap("goal")])
  where = goal + np.asarray(shift)
  where[:, 2] += height
  return put(task, state, "cup", where, turn)


def outward(task, state) -> np.ndarray:
  """Returns the horizontal directions f64[WORLDS, 3] from the base to the cup."""
  flat = np.asarray(pos(task, state, "cup"), np.float64) * [1, 1, 0]
  return flat / np.linalg.norm(flat, axis=-1, keepdims=True)


def hand(task, state, kinematics, half, reach, roll, *, back=0.0, aside=0.0):
  """Puts a horizontal tool along ``reach`` at a roll, with the cup between its pads.

  Or ``back`` m behind that and ``aside`` m to the left.
  """
  up = np.tile([0.0, 0.0, 1.0], (len(reach), 1))
  left = np.cross(up, reach)
  mat = np.stack([left, up, reach], -1) @ Rotation.from_euler("z", roll).as_matrix()
  depth = np.asarray(pinch_height(2 * half[:, 0]))[:, None] - back
  tool = pos(task, state, "cup") + depth * reach + aside * left
  return tool_at(task, kinematics, tool, mat)


def judge(task, state, kinematics) -> np.ndarray:
  return np.asarray(task.success(state, kinematics))


def test_resets_are_uniform_in_range(task, draw):
  address, _ = task.scene.free_joint("cup")
  cup, goal = draw.qpos[:, address : address + 2], draw.mocap_pos[:, 0, :2]
  polar = [
    np.stack([np.linalg.norm(spot, axis=-1), np.arctan2(*spot.T[::-1])], axis=-1)
    for spot in (cup, goal)
  ]

  def distance(pairs: np.ndarray) -> np.ndarray:
    """Computes distances from radius and direction by the law of cosines."""
    (a, b), turn = pairs[:, ::2].T, pairs[:, 1] - pairs[:, 3]
    return np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(turn))

  low, high = np.array(flip_cup.RANGE).T
  least = flip_cup.MIN_DISTANCE
  assert_pairs_are_uniform(np.hstack(polar), low, high, distance=distance, least=least)
  assert stats.chisquare(np.bincount(draw.variant)).pvalue > 1e-3
  np.testing.assert_allclose(
    draw.qpos[:, address + 2], np.array(flip_cup.SHAPES)[draw.variant, 2] / 2
  )
  frame = rotation(task, draw, "cup").as_matrix()
  axis, face = frame[:, :, 2], frame[:, :, 0]
  np.testing.assert_allclose(axis, np.tile([0, 0, -1], (len(axis), 1)), atol=1e-9)
  turn = np.arctan2(face[:, 1], face[:, 0]) - polar[0][:, 1]
  assert_uniform(turn, -flip_cup.MAX_YAW, flip_cup.MAX_YAW)


def test_the_small_image_shows_which_way_up_the_cup_is(task, resets, solved):
  forward, mouth = make_kinematics(task.scene), task.scene.id("geom", "mouth")
  down, up = (
    (segmentation(task.scene, forward(state)) == mouth).sum((1, 2))
    for state in (resets, solved)
  )
  assert down.max() == 0 and up.min() >= 8


def test_an_upright_cup_at_rest_on_the_goal_is_success(task, solved, kinematics):
  assert judge(task, solved, kinematics).all()


@pytest.mark.parametrize(
  ("shift", "turn", "expected"),
  [
    ((0.029, 0.0, 0.0), UPRIGHT, True),
    ((0.031, 0.0, 0.0), UPRIGHT, False),
    ((0.0, -0.031, 0.0), UPRIGHT, False),
    ((0.3, 0.0, 0.0), UPRIGHT, False),  # Upright anywhere else.
    ((0.0, 0.0, 0.009), UPRIGHT, True),
    ((0.0, 0.0, 0.011), UPRIGHT, False),  # In the air.
    ((0.0, 0.0, flip_cup.LIFT), UPRIGHT, False),
    ((0.0, 0.0, 0.0), UPSIDE_DOWN, False),
    ((0.0, 0.0, 0.0), Rotation.from_euler("x", 0.2), True),
    ((0.0, 0.0, 0.0), Rotation.from_euler("y", 0.3), False),  # Tipping.
    ((0.0, 0.0, 0.0), Rotation.from_euler("z", 2.0), True),
    ((0.0, 0.0, 0.0), Rotation.from_euler("x", np.pi / 2), False),
  ],
)
def test_success_has_limits(task, resets, half, kinematics, shift, turn, expected):
  state = on_goal(task, resets, half[:, 1], shift, turn)
  assert (judge(task, state, kinematics) == expected).all()


def test_a_lying_cup_is_not_success(task, resets, half, kinematics):
  lying = Rotation.from_euler("x", np.pi / 2)
  state = on_goal(task, resets, half[:, 0], turn=lying)
  assert not judge(task, state, kinematics).any()


@pytest.mark.parametrize(
  ("turn", "stands"),
  [(UPRIGHT, True), (UPSIDE_DOWN, False), (Rotation.from_euler("x", 0.7), False)],
)
def test_a_dropped_cup_counts_if_it_lands_upright(
  task, resets, half, kinematics, rest, turn, stands
):
  """The cases stay upright, stay upside down, and fall over."""
  steep = abs(turn.as_euler("xyz")[0])
  lowest = half[:, 1] * abs(np.cos(steep)) + half[:, 0] * abs(np.sin(steep))
  state = on_goal(task, resets, lowest, (0.0, 0.0, 0.02), turn)
  assert not judge(task, state, kinematics).any()
  assert (judge(task, rest(state), kinematics) == stands).all()


@pytest.mark.parametrize(("dof", "speed", "rests"), MOTIONS)
def test_a_moving_cup_is_not_success(task, solved, kinematics, dof, speed, rests):
  state = moving(task, solved, "cup", dof, speed)
  assert (judge(task, state, kinematics) == rests).all()


@pytest.mark.parametrize(
  ("back", "expected"), [(0.0, False), (0.049, False), (0.051, True)]
)
def test_the_hand_must_be_away(task, solved, half, kinematics, back, expected):
  reach = outward(task, solved)
  behind = hand(task, solved, kinematics, half, reach, np.pi / 2, back=back)
  for gap in (OPEN, 2 * half[:, 0]):
    state = with_gap(task, solved, gap)
    assert (judge(task, state, behind) == expected).all()


FUNNEL_WIDTH = FUNNEL - ALIGNED


@pytest.mark.parametrize(
  ("back", "aside", "gap", "twist", "funnel"),
  [
    # Out of line: behind the cup. In the funnel: nearer. Aligned: to the cup.
    (0.2, 0.1, OPEN, 0.0, 1.0),
    (0.09, -0.031, OPEN, 0.0, 0.5),
    (0.02, 0.031, OPEN, 0.0, 0.5),
    (0.09, 0.01, OPEN, 0.0, 0.0),
    (0.0, 0.0, OPEN, 0.0, 0.0),
    # A twist keeps the hand back, apart from the first 0.125 rad.
    (0.09, 0.0, OPEN, 0.12, 0.0),
    (0.09, 0.0, OPEN, -0.5, (0.05 * 0.375 - 0.012) / FUNNEL_WIDTH),
    # Fingers closed on nothing stay behind; those closing around the cup stay there.
    (0.05, 0.0, 0.02, 0.0, 1.0),
    (0.005, 0.0, 0.079, 0.0, 0.0),
  ],
)
def test_object_target(task, resets, half, kinematics, back, aside, gap, twist, funnel):
  """The hand is square to the face of the cup that points away from the base."""
  state, roll = with_gap(task, resets, gap), -np.pi / 2
  face = rotation(task, state, "cup").as_matrix()[:, :, 0]
  around = hand(task, state, kinematics, half, face, roll)
  grasp = around.site_xpos[:, task.scene.tool_site]
  now = hand(task, state, kinematics, half, face, roll + twist, back=back, aside=aside)
  positions, rotations, _ = task.tool_targets(state, now)
  expected = grasp - flip_cup.STANDOFF * funnel * face
  np.testing.assert_allclose(positions[:, 0], expected, atol=1e-4)
  expected = around.site_xmat[:, task.scene.tool_site]
  np.testing.assert_allclose(rotations[:, 0], expected, atol=1e-4)


@pytest.mark.parametrize("flip", [0.0, 0.8, 2.0, np.pi])
def test_a_held_cup_is_turned_upright_over_the_goal(
  task, resets, half, kinematics, flip
):
  """From any angle of the flip, high above the table."""
  site = task.scene.tool_site
  cup = pos(task, resets, "cup").at[:, 2].set(0.25)
  reach = outward(task, resets)
  heading = Rotation.from_euler("z", np.arctan2(reach[:, 1:2], reach[:, :1]))
  turned = Rotation.from_rotvec(flip * reach) * heading * UPSIDE_DOWN
  state = with_gap(task, put(task, resets, "cup", cup, turned), 2 * half[:, 0])
  held = hand(task, state, kinematics, half, reach, flip - np.pi / 2)
  positions, rotations, _ = task.tool_targets(state, held)
  tool, mat = held.site_xpos[:, site], held.site_xmat[:, site]
  # The object primitive stays with the cup, in the hand's own orientation.
  np.testing.assert_allclose(positions[:, 0], tool, atol=1e-4)
  np.testing.assert_allclose(rotations[:, 0], mat, atol=1e-3)
  # The goal primitive turns the cup upright.
  hand_turn = Rotation.from_matrix(np.asarray(rotations[:, 1])) * (
    Rotation.from_matrix(np.asarray(mat)).inv()
  )
  axis = (hand_turn * turned).as_matrix()[:, :, 2]
  np.testing.assert_allclose(axis, np.tile([0, 0, 1], (WORLDS, 1)), atol=2e-3)
  over = np.asarray(positions[:, 1] - tool + cup)[:, :2]
  goal = np.asarray(state.mocap_pos[:, 0, :2])
  # The pads stay around the cup's axis, whichever way the hand points at the goal.
  assert (np.linalg.norm(over - goal, axis=-1) < 0.03).all()


@pytest.mark.parametrize(
  ("at_goal", "gripped", "back", "row", "close"),
  [
    (False, False, 0.1, 0, 0),  # Reach.
    (False, False, 0.0, 0, 1),  # Close.
    (False, True, 0.0, 1, 1),  # Carry.
    (True, True, 0.0, 0, 0),  # Let go.
    (True, False, 0.0, 1, 0),  # Withdraw.
  ],
)
def test_the_expert_picks_and_places(
  task, resets, solved, half, kinematics, at_goal, gripped, back, row, close
):
  state = with_gap(
    task, solved if at_goal else resets, 2 * half[:, 0] if gripped else OPEN
  )
  roll = np.pi / 2 if at_goal else -np.pi / 2
  face = rotation(task, resets, "cup").as_matrix()[:, :, 0]
  reach = outward(task, state) if at_goal else face
  now = hand(task, state, kinematics, half, reach, roll, back=back)
  primitives = jnp.arange(WORLDS * 21.0).reshape(WORLDS, 3, 7)
  action = task.expert(state, now, primitives)
  np.testing.assert_array_equal(action, primitives[:, row])
  commands = task.tool_targets(state, now)[2]
  np.testing.assert_array_equal(commands[:, row], np.full(WORLDS, close))


def test_objects_are_the_poses_and_the_shape(task, resets, half):
  objects = np.asarray(task.objects(resets))
  cup = np.asarray(pos(task, resets, "cup"))
  np.testing.assert_allclose(objects[:, :3], cup)
  np.testing.assert_allclose(objects[:, 3:6], cup - [0, 0, 0.2], atol=1e-6)
  np.testing.assert_allclose(objects[:, 6:9], resets.mocap_pos[:, 0])
  corner = np.insert(half, 1, 0.0, axis=-1)  # Half the width, half the height.
  np.testing.assert_allclose(objects[:, 9:], cup + corner, atol=1e-6)
