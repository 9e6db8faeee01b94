"""Drawn initial states of every task, and the neutral primitive."""

from __future__ import annotations

import copy
import itertools

from hand_made import WORLDS, assert_uniform
import mujoco
import numpy as np
import pytest

from apnpql_jax.tasks import make_task, task_names


@pytest.fixture(scope="module", params=task_names())
def task(request):
  return make_task(request.param)


def test_the_robot_is_clear_and_nothing_overlaps(task, draw):
  """Distances are those of C MuJoCo."""
  model, variants = copy.copy(task.scene.model), task.scene.variants
  data = mujoco.MjData(model)
  solid = np.union1d(model.pair_geom1, model.pair_geom2)
  root = model.body_rootid[model.geom_bodyid]
  of_robot = root[solid] == root[model.geom("hand").id]
  pairs = list(itertools.product(solid[of_robot], solid[~of_robot]))
  rows = zip(*(x[:100] for x in draw), strict=True)
  for qpos, mocap_pos, mocap_quat, variant in rows:
    for field, values in variants.items():
      getattr(model, field)[:] = values[variant]
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, mocap_pos, mocap_quat
    mujoco.mj_forward(model, data)
    assert (data.contact.dist > -1e-5).all()
    for pair in pairs:
      assert mujoco.mj_geomDistance(model, data, *pair, 1.0, None) > 0.02


def test_the_arm_is_uniform_around_neutral(task, draw):
  joints = task.scene.arm_qpos
  arm = draw.qpos[:, joints] - task.scene.keyframe("neutral")[joints]
  assert_uniform(arm, -task.arm_noise, task.arm_noise)


def test_nothing_is_solved(task, resets, kinematics):
  assert not task.success(resets, kinematics).any()


def test_the_neutral_primitive_leads_to_the_keyframe(task, resets, kinematics, neutral):
  positions, rotations, _ = task.tool_targets(resets, kinematics)
  for actual, expected in ((positions, neutral[0]), (rotations, neutral[1])):
    expected = np.broadcast_to(expected, (WORLDS, *expected.shape))
    np.testing.assert_allclose(actual[:, 2], expected, atol=1e-5)
