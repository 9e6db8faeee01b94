"""The cost of a task's contacts: pairs, slots, constraint rows, steps per second."""

from __future__ import annotations

from collections.abc import Sequence
import time

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim import engines, physics
from apnpql_jax.sim.mjx import contact_slots
from apnpql_jax.tasks.task import Task

WORLDS = 64
SUBSTEPS = 30  # physics steps per timed call: one control period of 0.15 s at 5 ms
REPEATS = 3  # timed calls, after one that compiles; the fastest counts


def contact_report(
  task: Task, *, backends: Sequence[str] = ("native", "mjx")
) -> dict[str, float]:
  """Measures a task's scene on this machine, with the arm at rest.

  ``contacts`` and ``constraint_rows`` are the slots that MJX computes at every substep,
  whether anything touches or not; steps per second are summed over worlds.
  """
  scene, model = task.scene, task.scene.model
  contacts, rows = contact_slots(model)
  report = dict(pairs=model.npair, contacts=contacts, constraint_rows=rows)
  draw = task.sample_resets(np.random.default_rng(0), WORLDS)
  start = physics.initial_state(scene, *map(jnp.asarray, draw))
  still, close = jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS)
  for name in backends:
    step = jax.jit(engines.make_physics(name, scene, substeps=SUBSTEPS).step)
    state = jax.block_until_ready(step(start, still, close))
    fastest = float("inf")
    for _ in range(REPEATS):
      began = time.perf_counter()
      state = jax.block_until_ready(step(state, still, close))
      fastest = min(fastest, time.perf_counter() - began)
    report[f"{name}_steps_per_s"] = WORLDS * SUBSTEPS / fastest
  return report
