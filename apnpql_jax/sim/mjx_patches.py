"""Replacements for two functions that are slow in stock MJX.

Both are private to mujoco-mjx, so the patches are narrow. A barrier changes no value;
``tests/sim/test_mjx_patches.py`` compares the Newton direction with stock MJX.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.quiet_mjx import mjx

_scan, _solver = mjx._src.scan, mjx._src.solver


def patch_mjx() -> None:
  """Applies both patches; safe to call again.

  Kinematic chains: on the CPU, XLA's fusion duplicates the work of a parent body into
  each child. On a chain of eight bodies this makes stock MJX three orders of magnitude
  slower under vmap. An optimization barrier after every body prevents it.

  Elliptic cones: to add up their Hessians, the solver multiplies the Jacobian by a
  dense matrix of rows x rows, which is zero outside one block of at most 6 x 6 per
  contact. Summing over the blocks makes cost and memory linear in the rows.
  """
  if jax.default_backend() == "cpu":
    _scan.body_tree = _guarded_body_tree
  _solver._update_gradient = _update_gradient


def _guarded_body_tree(m, f, in_types, out_types, *args, reverse=False):
  def guarded(*inputs):
    return jax.lax.optimization_barrier(f(*inputs))

  return _stock_body_tree(m, guarded, in_types, out_types, *args, reverse=reverse)


def _update_gradient(m, d, ctx):
  """Computes gradient and Newton direction; stock unless Newton with elliptic cones."""
  elliptic = m.opt.cone == mjx.ConeType.ELLIPTIC
  if not elliptic or m.opt.solver != mjx.SolverType.NEWTON:
    return _stock_update_gradient(m, d, ctx)
  jacobian = d._impl.efc_J
  weighted = (d._impl.efc_D * ctx.active)[:, None] * jacobian
  contact = d._impl.contact
  dims = contact.dim[contact.dim > 1]
  addresses = contact.efc_address[contact.dim > 1]
  for dim in np.unique(dims):
    # Contacts of one dimension are contiguous: a slice, not a gather.
    chosen = np.flatnonzero(dims == dim)
    first, last = addresses[chosen[0]], addresses[chosen[-1]] + dim
    cones = ctx.h[chosen[0] : chosen[-1] + 1, :dim, :dim]
    rows = jacobian[first:last].reshape(len(chosen), dim, -1)
    # Not a matrix product: XLA:CPU would call one for each of these small blocks.
    added = jnp.sum(cones[..., None] * rows[:, None], axis=2)
    weighted = weighted.at[first:last].add(added.reshape(last - first, -1))
  hessian = mjx.full_m(m, d) + jacobian.T @ weighted
  factor = jax.scipy.linalg.cho_factor((hessian + hessian.T) / 2)
  gradient = ctx.Ma - d.qfrc_smooth - ctx.qfrc_constraint
  step = jax.scipy.linalg.cho_solve(factor, gradient)
  return ctx.replace(grad=gradient, Mgrad=step)


_stock_body_tree = _scan.body_tree
_stock_update_gradient = _solver._update_gradient
