"""push_plate: resets, success on hand-made states, privileged quantities."""

from __future__ import annotations

from hand_made import apart, assert_arm_is_uniform, assert_pairs_are_uniform
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import push_plate, task_names


@pytest.fixture(scope="module")
def solved(task, resets):
  """All worlds with the plate at rest exactly on the goal."""
  plate, _ = task.scene.free_joint("plate")
  goal = resets.mocap_pos[:, task.scene.mocap("goal"), :2]
  return resets.replace(qpos=resets.qpos.at[:, plate : plate + 2].set(goal))


def judge(task, state) -> np.ndarray:
  return np.asarray(task.success(state, None))


def moved(task, state, x=0.0, z=0.0):
  plate, _ = task.scene.free_joint("plate")
  qpos = state.qpos.at[:, plate].add(x).at[:, plate + 2].add(z)
  return state.replace(qpos=qpos)


def test_it_is_registered():
  assert "push_plate" in task_names()


def test_resets_are_unsolved_and_in_range(task, resets):
  assert not judge(task, resets).any()
  plate, _ = task.scene.free_joint("plate")
  qpos, mocap_pos, *_ = task.sample_resets(np.random.default_rng(0), 2000)
  assert_arm_is_uniform(task, qpos)
  spots = np.hstack([qpos[:, plate : plate + 2], mocap_pos[:, 0, :2]])
  low, high = np.array(push_plate.WORKSPACE).T
  least = push_plate.MIN_DISTANCE
  assert_pairs_are_uniform(spots, low, high, distance=apart, least=least)


def test_plate_at_rest_on_the_goal_is_success(task, solved):
  assert judge(task, solved).all()


@pytest.mark.parametrize(
  ("x", "z", "expected"),
  [(0.029, 0.0, True), (0.031, 0.0, False), (-0.031, 0.0, False), (0.0, 0.02, False)],
)
def test_the_goal_has_an_edge_and_a_height(task, solved, x, z, expected):
  assert (judge(task, moved(task, solved, x, z)) == expected).all()


def test_a_moving_plate_is_no_success(task, solved):
  _, dof = task.scene.free_joint("plate")
  sliding = solved.replace(qvel=solved.qvel.at[:, dof].set(0.06))
  assert not judge(task, sliding).any()
  resting = solved.replace(qvel=solved.qvel.at[:, dof].set(0.04))
  assert judge(task, resting).all()


def test_targets_depend_on_where_the_tool_is(task, resets):
  """Above and off the plate: hover. Above it: descend. Inside it: drag."""
  kinematics = jax.jit(make_kinematics(task.scene))(resets)
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
  beside = targets(spot + 0.15, push_plate.DRAG_HEIGHT)
  np.testing.assert_allclose(beside[:, 0, :2], spot + 0.15, atol=1e-6)
  np.testing.assert_allclose(beside[:, :2, 2], push_plate.HOVER_HEIGHT)


def test_objects_are_the_poses(task, resets):
  plate, _ = task.scene.free_joint("plate")
  objects = task.objects(resets)
  np.testing.assert_array_equal(objects[:, :3], resets.qpos[:, plate : plate + 3])
  np.testing.assert_array_equal(objects[:, 3:], jnp.asarray(resets.mocap_pos[:, 0]))
