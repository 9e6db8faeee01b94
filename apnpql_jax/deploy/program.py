"""A policy as one program of ``jax.export``, with its weights inside."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, UInt32
import numpy as np

from apnpql_jax.agents.learner import Agent
from apnpql_jax.agents.networks import Params
from apnpql_jax.errors import UserError, one_line
from apnpql_jax.types import Array, Observation

PLATFORMS = ("cpu", "cuda")

Act = Callable[[dict[str, Array], UInt32[Array, " 2"]], Float[Array, "1 7"]]
"""(observation by field, data of a key) -> action."""


@dataclasses.dataclass(frozen=True)
class Program:
  """An exported policy."""

  data: bytes
  """What ``jax.export.deserialize`` reads."""

  needs_key: bool
  """Whether the action depends on the key."""

  calling_convention: int
  """Version of the calling convention of ``jax.export``."""


def make_act(agent: Agent, params: Params, *, acting: str) -> Act:
  """Returns the policy as a function of plain arrays, with its weights inside.

  ``acting`` is a rule of ``agents/acting.py``. The key is data of a threefry key, as
  ``jax.random.key_data(jax.random.key(0))``.
  """
  constants = jax.tree.map(np.asarray, params)

  def act(observation: dict[str, Array], key: Array) -> Array:
    # Behind the barrier the weights are as they are in a run, where they are arguments.
    # XLA would otherwise fuse the constants, and round sums in another order.
    weights = jax.lax.optimization_barrier(jax.tree.map(jnp.asarray, constants))
    typed = jax.random.wrap_key_data(key, impl="threefry2x32")
    return agent.act(weights, Observation(**observation), typed, acting=acting)[0]

  return act


def export(act: Act, shapes: dict[str, Any]) -> Program:
  """Exports a policy for ``PLATFORMS``.

  Args:
    act: The policy.
    shapes: ShapeDtypeStructs of an observation with a batch axis of 1.

  Raises:
    UserError: The program calls code of this process, or something else that
      ``jax.export`` cannot store.
  """
  key = jax.ShapeDtypeStruct((2,), jnp.uint32)
  try:
    with _without_locations():
      exported = jax.export.export(jax.jit(act), platforms=PLATFORMS)(shapes, key)
    data = bytes(exported.serialize())
  except Exception as error:  # Whatever JAX raises; its messages name the cause.
    raise UserError(f"this policy cannot be exported: {one_line(error)}") from error
  last = len(shapes)  # The arguments in order: the fields by name, then the key.
  needs_key = last in exported.module_kept_var_idx
  return Program(data, needs_key, exported.calling_convention_version)


@contextlib.contextmanager
def _without_locations() -> Generator[None, None, None]:
  """Keeps paths of this machine out of programs, so that equal ones have one hash."""
  name = "jax_traceback_in_locations_limit"
  before = getattr(jax.config, name)
  jax.config.update(name, 0)
  try:
    yield
  finally:
    jax.config.update(name, before)
