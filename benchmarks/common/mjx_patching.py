"""MJX with or without the patches of ``sim.mjx_patches``."""

from collections.abc import Generator
import contextlib
from unittest import mock

from apnpql_jax.sim import mjx_patches


@contextlib.contextmanager
def patched(*, barrier: bool, cones: bool) -> Generator[None]:
  """Traces MJX inside with these patches: barriers behind bodies, cones in blocks."""
  scan, solver = mjx_patches._scan, mjx_patches._solver
  body_tree = "_guarded_body_tree" if barrier else "_stock_body_tree"
  gradient = "_update_gradient" if cones else "_stock_update_gradient"
  with (
    mock.patch.object(scan, "body_tree", getattr(mjx_patches, body_tree)),
    mock.patch.object(solver, "_update_gradient", getattr(mjx_patches, gradient)),
  ):
    yield
