"""push_plate: resets, success on hand-made states, tool targets."""

from __future__ import annotations

from hand_made import (
  MOTIONS,
  apart,
  assert_pairs_are_uniform,
  assert_uniform,
  moving,
  pos,
  put,
  rotation,
)
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.tasks import push_plate


@pytest.fixture(scope="module")
def solved(task, resets):
  """Returns worlds with the plate at rest exactly on the goal."""
  goal = resets.mocap_pos[:, task.scene.mocap("goal"), :2]
  plate = pos(task, resets, "plate").at[:, :2].set(goal)
  return put(task, resets, "plate", plate)


def judge(task, state) -> np.ndarray:
  return np.asarray(task.success(state, None))


def moved(task, state, x=0.0, y=0.0, z=0.0):
  return put(task, state, "plate", pos(task, state, "plate") + jnp.array([x, y, z]))


def test_resets_are_uniform_in_range(task, draw):
  turn = rotation(task, draw, "plate").as_rotvec()
  np.testing.assert_allclose(turn[:, :2], 0, atol=1e-12)
  assert_uniform(turn[:, 2], -np.pi, np.pi)
  spots = np.hstack([pos(task, draw, "plate")[:, :2], draw.mocap_pos[:, 0, :2]])
  low, high = np.array(push_plate.WORKSPACE).T
  least = push_plate.MIN_DISTANCE
  assert_pairs_are_uniform(spots, low, high, distance=apart, least=least)


def test_plate_at_rest_on_the_goal_is_success(task, solved):
  assert judge(task, solved).all()


@pytest.mark.parametrize(
  ("x", "y", "z", "expected"),
  [
    (0.029, 0.0, 0.0, True),
    (0.031, 0.0, 0.0, False),
    (-0.031, 0.0, 0.0, False),
    (0.0, -0.029, 0.0, True),
    (-0.022, 0.022, 0.0, False),  # Round, not square.
    (0.5, 0.0, 0.0, False),
    (0.0, 0.0, 0.006, True),
    (0.0, 0.0, 0.008, False),  # In the air.
    (0.0, 0.0, 0.1, False),
  ],
)
def test_the_goal_has_an_edge_and_a_height(task, solved, x, y, z, expected):
  assert (judge(task, moved(task, solved, x, y, z)) == expected).all()


def turned(task, state, axis, angle):
  turn = rotation(task, state, "plate") * Rotation.from_euler(axis, angle)
  return put(task, state, "plate", turn=turn)


@pytest.mark.parametrize(
  ("axis", "angle", "expected"),
  [("z", 2.0, True), ("x", 0.2, True), ("y", 0.3, False), ("x", np.pi, False)],
)
def test_the_plate_must_lie_flat(task, solved, axis, angle, expected):
  assert (judge(task, turned(task, solved, axis, angle)) == expected).all()


def test_a_plate_upside_down_is_not_success(task, solved, rest):
  """Only its floor touches the table, so that its center is as low as when upright."""
  state = rest(turned(task, solved, "x", np.pi))
  np.testing.assert_allclose(pos(task, state, "plate")[:, 2], 0.003, atol=1e-3)
  assert not judge(task, state).any()


def test_a_dropped_plate_counts_when_it_has_landed(task, solved, rest):
  state = moved(task, solved, z=0.03)
  assert not judge(task, state).any()
  assert judge(task, rest(state)).all()


@pytest.mark.parametrize(("dof", "speed", "rests"), MOTIONS)
def test_a_moving_plate_is_not_success(task, solved, dof, speed, rests):
  assert (judge(task, moving(task, solved, "plate", dof, speed)) == rests).all()


def test_targets_depend_on_where_the_tool_is(task, resets, kinematics):
  """Above and off the plate: hover. Above it: descend. Inside it: drag."""
  plate, _ = task.scene.free_joint("plate")
  spot = resets.qpos[:, plate : plate + 2]
  goal = resets.mocap_pos[:, 0, :2]

  def targets(xy, height):
    site = kinematics.site_xpos.at[:, task.scene.tool_site, :2].set(xy)
    site = site.at[:, task.scene.tool_site, 2].set(height)
    return task.tool_targets(resets, kinematics.replace(site_xpos=site))[0]

  off = targets(spot + 0.1, 0.2)
  np.testing.assert_allclose(off[:, 0, :2], spot, atol=1e-6)
  np.testing.assert_allclose(off[:, 0, 2], push_plate.HOVER_HEIGHT)
  np.testing.assert_allclose(off[:, 1, :2], goal, atol=1e-6)
  above = targets(spot + 0.01, 0.06)
  np.testing.assert_allclose(above[:, 0, 2], push_plate.DRAG_HEIGHT)
  inside = targets(spot + 0.02, push_plate.DRAG_HEIGHT)
  step = np.asarray(inside[:, 1, :2] - (spot + 0.02))
  lengths = np.linalg.norm(step, axis=-1)
  np.testing.assert_allclose(lengths, push_plate.LOOKAHEAD, atol=1e-5)
  way = np.asarray(goal - spot)
  cosine = (step * way).sum(-1) / (lengths * np.linalg.norm(way, axis=-1))
  np.testing.assert_allclose(cosine, 1.0, atol=1e-5)
  outside = targets(spot + 0.15, push_plate.DRAG_HEIGHT)
  np.testing.assert_allclose(outside[:, 0, :2], spot + 0.15, atol=1e-6)
  np.testing.assert_allclose(outside[:, :2, 2], push_plate.HOVER_HEIGHT)


def test_objects_are_the_poses(task, resets):
  plate, _ = task.scene.free_joint("plate")
  objects = task.objects(resets)
  np.testing.assert_array_equal(objects[:, :3], resets.qpos[:, plate : plate + 3])
  np.testing.assert_array_equal(objects[:, 3:], jnp.asarray(resets.mocap_pos[:, 0]))
