"""Drawn initial states of every task: what is clear of what, by C MuJoCo."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest

from apnpql_jax.tasks import make_task, task_names


@pytest.mark.parametrize("name", task_names())
def test_the_robot_is_clear_and_nothing_is_inside_anything(name):
  task = make_task(name)
  model, variants = task.scene.model, task.scene.variants
  data = mujoco.MjData(model)
  solid = np.union1d(model.pair_geom1, model.pair_geom2)
  root = model.body_rootid[model.geom_bodyid]
  of_robot = root[solid] == root[model.geom("hand").id]
  pairs = list(itertools.product(solid[of_robot], solid[~of_robot]))
  draw = task.sample_resets(np.random.default_rng(0), 100)
  for qpos, mocap_pos, mocap_quat, variant in zip(*draw, strict=True):
    for field, values in variants.items():
      getattr(model, field)[:] = values[variant]
    data.qpos[:], data.mocap_pos[:], data.mocap_quat[:] = qpos, mocap_pos, mocap_quat
    mujoco.mj_forward(model, data)
    assert (data.contact.dist > -1e-5).all()
    for pair in pairs:
      assert mujoco.mj_geomDistance(model, data, *pair, 1.0, None) > 0.02
