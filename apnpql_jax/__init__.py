"""AP-NPQL on JAX and MuJoCo: pixels to policy with one command."""

from __future__ import annotations

from apnpql_jax import runtime

__version__ = "0.1.0"

# Before anything else of the package: JAX reads these settings once, when its
# backend starts.
runtime.configure()
