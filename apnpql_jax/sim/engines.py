"""Physics engines by name."""

from __future__ import annotations

import jax

from apnpql_jax.config.checks import BACKENDS
from apnpql_jax.errors import check_name
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.sim.native import NativePhysics
from apnpql_jax.sim.physics import Physics
from apnpql_jax.sim.scene import Scene


def make_physics(name: str, scene: Scene, *, substeps: int) -> Physics:
  """Engine ``name``; "auto" takes C MuJoCo on a bare CPU and MJX elsewhere.

  Raises:
    ConfigError: unknown name.
  """
  check_name("backend", name, BACKENDS)
  if name == "auto":
    name = "native" if jax.default_backend() == "cpu" else "mjx"
  if name == "native":
    return NativePhysics(scene, substeps=substeps)
  return MjxPhysics(scene, substeps=substeps)
