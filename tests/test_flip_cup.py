"""flip_cup: resets, success on hand-made states, targets through a flip."""

from __future__ import annotations

from hand_made import (
  assert_arm_is_uniform,
  assert_pairs_are_uniform,
  assert_uniform,
  put,
  tool_at,
)
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from apnpql_jax.render import CameraSpec, Geoms, render
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import flip_cup, make_task
from apnpql_jax.tasks.pinch import finger_angle, pinch_height

WORLDS = 12
UPRIGHT = Rotation.identity()
UPSIDE_DOWN = Rotation.from_euler("x", np.pi)


@pytest.fixture(scope="module")
def task():
  return make_task("flip_cup")


@pytest.fixture(scope="module")
def kinematics_of(task):
  return jax.jit(make_kinematics(task.scene))


@pytest.fixture(scope="module")
def resets(task) -> physics.PhysicsState:
  """Initial states with the three shapes in turn."""
  draw = task.sample_resets(np.random.default_rng(0), WORLDS)
  variant = np.arange(WORLDS) % 3
  address, _ = task.scene.free_joint("cup")
  draw.qpos[:, address + 2] = np.array(flip_cup.SHAPES)[variant, 2] / 2
  draw = draw._replace(variant=variant)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw))


@pytest.fixture(scope="module")
def half_heights() -> np.ndarray:
  return np.array(flip_cup.SHAPES)[np.arange(WORLDS) % 3, 2] / 2


def on_goal(task, state, half_heights, shift=(0.0, 0.0, 0.0), turn=UPRIGHT):
  goal = np.asarray(state.mocap_pos[:, task.scene.mocap("goal")])
  where = goal + np.asarray(shift)
  where[:, 2] += half_heights
  return put(task, state, "cup", where, turn)


def judge(task, state, kinematics) -> np.ndarray:
  return np.asarray(task.success(state, kinematics))


def test_resets_are_unsolved_and_in_range(task, resets, kinematics_of):
  assert not judge(task, resets, kinematics_of(resets)).any()
  address, _ = task.scene.free_joint("cup")
  qpos, mocap_pos, _, variant = task.sample_resets(np.random.default_rng(1), 3000)
  assert_arm_is_uniform(task, qpos)
  cup, goal = qpos[:, address : address + 2], mocap_pos[:, 0, :2]
  polar = [
    np.stack([np.linalg.norm(spot, axis=-1), np.arctan2(*spot.T[::-1])], axis=-1)
    for spot in (cup, goal)
  ]

  def distance(pairs: np.ndarray) -> np.ndarray:
    """By the law of cosines, of pairs of radius and direction."""
    (a, b), turn = pairs[:, ::2].T, pairs[:, 1] - pairs[:, 3]
    return np.sqrt(a**2 + b**2 - 2 * a * b * np.cos(turn))

  low, high = np.array(flip_cup.RANGE).T
  least = flip_cup.MIN_DISTANCE
  assert_pairs_are_uniform(np.hstack(polar), low, high, distance=distance, least=least)
  assert stats.chisquare(np.bincount(variant)).pvalue > 1e-3
  np.testing.assert_allclose(
    qpos[:, address + 2], np.array(flip_cup.SHAPES)[variant, 2] / 2
  )
  quat = qpos[:, address + 3 : address + 7]
  axis = Rotation.from_quat(quat, scalar_first=True).as_matrix()[:, :, 2]
  np.testing.assert_allclose(axis, np.tile([0, 0, -1], (3000, 1)), atol=1e-9)
  face = Rotation.from_quat(quat, scalar_first=True).as_matrix()[:, :, 0]
  turn = np.arctan2(face[:, 1], face[:, 0]) - polar[0][:, 1]
  assert_uniform(turn, -flip_cup.MAX_YAW, flip_cup.MAX_YAW)


def test_the_small_image_shows_which_way_up_the_cup_is(
  task, resets, half_heights, kinematics_of
):
  model = task.scene.model
  camera = task.scene.id("camera", "global")
  spec = CameraSpec.from_model(model, "global", height=72, width=96)

  def mouth_pixels(state: physics.PhysicsState) -> np.ndarray:
    kinematics = kinematics_of(state)
    image = render(
      Geoms.from_model(model),
      spec,
      kinematics.geom_xpos,
      kinematics.geom_xmat,
      kinematics.cam_xpos[:, camera],
      kinematics.cam_xmat[:, camera],
      fields=kinematics.fields,
      outputs=("segmentation",),
    )
    return np.sum(image.segmentation == task.scene.id("geom", "mouth"), axis=(1, 2))

  assert not mouth_pixels(resets).any()
  assert mouth_pixels(on_goal(task, resets, half_heights)).min() >= 8


def test_an_upright_cup_at_rest_on_the_goal_is_success(
  task, resets, half_heights, kinematics_of
):
  state = on_goal(task, resets, half_heights)
  assert judge(task, state, kinematics_of(state)).all()


@pytest.mark.parametrize(
  ("shift", "turn", "expected"),
  [
    ((0.029, 0.0, 0.0), UPRIGHT, True),
    ((0.031, 0.0, 0.0), UPRIGHT, False),
    ((0.0, 0.0, 0.009), UPRIGHT, True),
    ((0.0, 0.0, 0.011), UPRIGHT, False),  # In the air.
    ((0.0, 0.0, 0.0), UPSIDE_DOWN, False),
    ((0.0, 0.0, 0.0), Rotation.from_euler("x", 0.2), True),
    ((0.0, 0.0, 0.0), Rotation.from_euler("y", 0.3), False),  # Tipping.
    ((0.0, 0.0, 0.0), Rotation.from_euler("z", 2.0), True),
    ((0.0, 0.0, 0.0), Rotation.from_euler("x", np.pi / 2), False),
  ],
)
def test_success_has_limits(
  task, resets, half_heights, kinematics_of, shift, turn, expected
):
  state = on_goal(task, resets, half_heights, shift, turn)
  assert (judge(task, state, kinematics_of(state)) == expected).all()


def test_a_lying_cup_is_no_success(task, resets, kinematics_of):
  half = np.array(flip_cup.SHAPES)[np.arange(WORLDS) % 3, 1]
  state = on_goal(task, resets, half, turn=Rotation.from_euler("x", np.pi / 2))
  assert not judge(task, state, kinematics_of(state)).any()


@pytest.mark.parametrize(
  ("dof", "speed", "expected"),
  [(0, 0.06, False), (2, -0.06, False), (0, 0.04, True), (5, 0.6, False)],
)
def test_a_moving_cup_is_no_success(
  task, resets, half_heights, kinematics_of, dof, speed, expected
):
  _, start = task.scene.free_joint("cup")
  state = on_goal(task, resets, half_heights)
  state = state.replace(qvel=state.qvel.at[:, start + dof].set(speed))
  assert (judge(task, state, kinematics_of(state)) == expected).all()


def hand(task, state, kinematics, cup, roll: float):
  """Kinematics with a horizontal tool around ``cup``, turned by ``roll``."""
  flat = np.array(cup)
  flat[:, 2] = 0
  reach = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
  left = np.cross([0.0, 0.0, 1.0], reach)
  up = np.tile([0.0, 0.0, 1.0], (len(reach), 1))
  mat = np.stack([left, up, reach], -1) @ Rotation.from_euler("z", roll).as_matrix()
  width = 2 * np.array(flip_cup.SHAPES)[np.arange(WORLDS) % 3, 1]
  tool = cup + np.asarray(pinch_height(width))[:, None] * reach
  return tool_at(task, kinematics, tool, mat)


def gripping(task, state):
  """The fingers closed to the width of each cup."""
  width = 2 * np.array(flip_cup.SHAPES)[np.arange(WORLDS) % 3, 1]
  start = task.scene.gripper_qpos
  angle = finger_angle(width)[:, None]
  return state.replace(qpos=state.qpos.at[:, start : start + 4].set(angle))


def test_a_cup_that_is_still_held_is_no_success(
  task, resets, half_heights, kinematics_of
):
  state = gripping(task, on_goal(task, resets, half_heights))
  kinematics = kinematics_of(state)
  address, _ = task.scene.free_joint("cup")
  cup = np.asarray(state.qpos[:, address : address + 3])
  held = hand(task, state, kinematics, cup, np.pi / 2)
  assert not judge(task, state, held).any()


@pytest.mark.parametrize("flip", [0.0, 0.8, 2.0, np.pi])
def test_a_held_cup_is_lifted_and_turned_on(task, resets, kinematics_of, flip):
  """From any angle of the flip, above the table: on towards upright, over the goal."""
  address, _ = task.scene.free_joint("cup")
  cup = np.asarray(resets.qpos[:, address : address + 3], np.float64)
  cup[:, 2] = 0.25
  flat = cup * [1, 1, 0]
  reach = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
  heading = Rotation.from_euler("z", np.arctan2(reach[:, 1:2], reach[:, :1]))
  state = gripping(task, put(task, resets, "cup", cup, heading * UPSIDE_DOWN))
  turned = Rotation.from_rotvec(flip * reach) * heading * UPSIDE_DOWN
  state = put(task, state, "cup", cup, turned)
  held = hand(task, state, kinematics_of(state), cup, flip - np.pi / 2)
  positions, rotations, _ = task.tool_targets(state, held)
  tool = held.site_xpos[:, task.scene.tool_site]
  # The object primitive stays with the cup, in the hand's own orientation.
  np.testing.assert_allclose(positions[:, 0], tool, atol=1e-4)
  np.testing.assert_allclose(
    rotations[:, 0], held.site_xmat[:, task.scene.tool_site], atol=1e-3
  )
  # The goal primitive turns the cup upright.
  hand_turn = Rotation.from_matrix(np.asarray(rotations[:, 1])) * (
    Rotation.from_matrix(np.asarray(held.site_xmat[:, task.scene.tool_site])).inv()
  )
  axis = (hand_turn * turned).as_matrix()[:, :, 2]
  np.testing.assert_allclose(axis, np.tile([0, 0, 1], (WORLDS, 1)), atol=2e-3)
  over = np.asarray(positions[:, 1] - tool)[:, :2] + cup[:, :2]
  goal = np.asarray(state.mocap_pos[:, 0, :2])
  # The pads stay around the cup's axis, whichever way the hand points at the goal.
  assert (np.linalg.norm(over - goal, axis=-1) < 0.03).all()


def test_objects_are_the_poses_and_the_shape(task, resets):
  objects = np.asarray(task.objects(resets))
  address, _ = task.scene.free_joint("cup")
  cup = np.asarray(resets.qpos[:, address : address + 3])
  shapes = np.array(flip_cup.SHAPES)[np.arange(WORLDS) % 3]
  np.testing.assert_allclose(objects[:, :3], cup)
  np.testing.assert_allclose(objects[:, 3:6], 0 * cup - [0, 0, 0.2], atol=1e-6)
  np.testing.assert_allclose(objects[:, 6:9], resets.mocap_pos[:, 0])
  np.testing.assert_allclose(objects[:, 9:], shapes[:, 1:] / [1, 2], atol=1e-6)
