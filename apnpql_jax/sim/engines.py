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
  """Builds an engine; "auto" is C MuJoCo if JAX runs on the CPU, and MJX elsewhere.

  Raises:
    ConfigError: The name is unknown.
  """
  check_name("backend", name, BACKENDS)
  if name == "auto":
    name = "native" if jax.default_backend() == "cpu" else "mjx"
  engine = NativePhysics if name == "native" else MjxPhysics
  return engine(scene, substeps=substeps)
