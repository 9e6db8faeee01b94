"""MJX with some of ``sim.mjx_patches`` or none, while something is traced."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
from unittest import mock

from mujoco.mjx._src import scan, solver

from apnpql_jax.sim import mjx_patches


@contextlib.contextmanager
def cures(*, barrier: bool, cones: bool) -> Generator[None, None, None]:
  """Inside, MJX has the barrier behind each body, and cones in blocks, or has not."""
  body_tree = "_guarded_body_tree" if barrier else "_stock_body_tree"
  gradient = "_update_gradient" if cones else "_stock_update_gradient"
  with (
    mock.patch.object(scan, "body_tree", getattr(mjx_patches, body_tree)),
    mock.patch.object(solver, "_update_gradient", getattr(mjx_patches, gradient)),
  ):
    yield
