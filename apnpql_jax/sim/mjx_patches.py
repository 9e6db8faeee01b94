"""Two places where stock MJX is slower than it need be, mended without copying it.

Both functions are private to mujoco-mjx, hence the narrow patches. A barrier changes no
value; ``tests/test_mjx_patches.py`` compares the Newton direction with stock MJX.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from mujoco import mjx
from mujoco.mjx._src import scan as _scan, solver as _solver
import numpy as np


def patch_mjx() -> None:
  """Applies both patches; repeating it changes nothing.

  Kinematic chains: on the CPU, XLA's fusion duplicates the work of a parent body into
  each child: on a chain of eight bodies stock MJX is three orders of magnitude slower
  under vmap. An optimization barrier behind every body ends it.

  Elliptic cones: to add up their Hessians, the solver multiplies the Jacobian by a
  dense matrix of rows x rows, of which only a block of at most 6 x 6 per contact
  differs from zero. Summing over the blocks makes cost and memory linear in the rows.
  """
  if jax.default_backend() == "cpu":
    _scan.body_tree = _guarded_body_tree
  _solver._update_gradient = _update_gradient


def _guarded_body_tree(m, f, in_types, out_types, *args, reverse=False):
  def behind_barrier(*inputs):
    return jax.lax.optimization_barrier(f(*inputs))

  return _stock_body_tree(
    m, behind_barrier, in_types, out_types, *args, reverse=reverse
  )


def _update_gradient(m, d, ctx):
  """Gradient and Newton direction; stock for all but Newton with elliptic cones."""
  elliptic = m.opt.cone == mjx.ConeType.ELLIPTIC
  if not elliptic or m.opt.solver != mjx.SolverType.NEWTON:
    return _stock_update_gradient(m, d, ctx)
  jacobian = d._impl.efc_J
  weighted = (d._impl.efc_D * ctx.active)[:, None] * jacobian
  contact = d._impl.contact
  dims = contact.dim[contact.dim > 1]
  addresses = contact.efc_address[contact.dim > 1]
  for dim in np.unique(dims):
    # Contacts of one dimension lie together: a slice, not a gather.
    chosen = np.flatnonzero(dims == dim)
    first, last = addresses[chosen[0]], addresses[chosen[-1]] + dim
    cones = ctx.h[chosen[0] : chosen[-1] + 1, :dim, :dim]
    rows = jacobian[first:last].reshape(len(chosen), dim, -1)
    # Not a product of matrices: XLA:CPU calls one for each of these small blocks.
    added = jnp.sum(cones[..., None] * rows[:, None], axis=2)
    weighted = weighted.at[first:last].add(added.reshape(last - first, -1))
  hessian = mjx.full_m(m, d) + jacobian.T @ weighted
  factor = jax.scipy.linalg.cho_factor((hessian + hessian.T) / 2)
  gradient = ctx.Ma - d.qfrc_smooth - ctx.qfrc_constraint
  step = jax.scipy.linalg.cho_solve(factor, gradient)
  return ctx.replace(grad=gradient, Mgrad=step)


_stock_body_tree = _scan.body_tree
_stock_update_gradient = _solver._update_gradient
