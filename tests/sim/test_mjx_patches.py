"""The patched functions of MJX compute what stock MJX computes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import solver
import numpy as np

from apnpql_jax.sim import mjx_patches, physics
from apnpql_jax.tasks import make_task

WORLDS = 8


def test_newton_direction_equals_stock():
  """A box slides over the table: some contacts are on the curved side of the cone."""
  task = make_task("stack_box")
  address, dof = task.scene.free_joint("yellow")
  draw = task.sample_resets(np.random.default_rng(0), WORLDS)
  state = physics.initial_state(task.scene, *map(jnp.asarray, draw))
  model = mjx.put_model(task.scene.model, impl="jax")
  empty = mjx.make_data(task.scene.model, impl="jax")
  mjx_patches.patch_mjx()

  def directions(qpos, qvel):
    data = empty.replace(qpos=qpos, qvel=qvel)
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    data = mjx.fwd_acceleration(model, data)
    context = solver.Context.create(model, data.replace(qacc=data.qacc_smooth))
    stock = mjx_patches._stock_update_gradient(model, data, context)
    return context.h, stock, solver._update_gradient(model, data, context)

  speed = np.random.default_rng(1).uniform(-1, 1, (WORLDS, 2))
  qvel = state.qvel.at[:, dof : dof + 2].set(speed)
  qpos = state.qpos.at[:, address + 2].add(-5e-4)  # Into the table.
  cones, stock, patched = jax.jit(jax.vmap(directions))(qpos, qvel)
  sliding = np.any(np.asarray(cones) != 0, axis=(2, 3))
  assert sliding.any(axis=1).all() and not sliding.all()
  assert solver._update_gradient is not mjx_patches._stock_update_gradient
  scale = np.abs(stock.Mgrad).max(axis=1, keepdims=True)
  np.testing.assert_allclose(patched.Mgrad / scale, stock.Mgrad / scale, atol=1e-4)
  np.testing.assert_array_equal(patched.grad, stock.grad)
