"""Settings shared by all tests."""

from __future__ import annotations

from collections.abc import Callable
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import apnpql_jax  # noqa: F401  (sets threads and the compilation cache)
from apnpql_jax.sim import physics
from apnpql_jax.tasks import Task, make_task

# Figures are written to files; no test may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")

WORLDS = 16
"""Batch size of the shared fixtures: one size, one compilation."""


@pytest.fixture(scope="session")
def task() -> Task:
  """The shipped push_plate task."""
  return make_task("push_plate")


@pytest.fixture(scope="session")
def engines(task: Task) -> dict[str, Callable]:
  """Engine name -> jitted control period over worlds; compiled once per shape."""
  return {
    name: jax.jit(physics.make_physics(name, task.scene, substeps=30).step)
    for name in ("native", "mjx")
  }


@pytest.fixture(scope="session")
def resets(task: Task) -> physics.PhysicsState:
  """``WORLDS`` initial states as the task draws them."""
  draw = task.sample_resets(np.random.default_rng(3), WORLDS)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw))
