"""Least time that a computation can take on this machine.

Operations and bytes are counted and divided by what a large matrix product and a large
copy reach on the same machine. The larger of the two times is the floor. It bounds the
program as it is written, not the best program for the purpose.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import functools
import time
from typing import Any, NamedTuple

import jax
from jax.extend import core
import jax.numpy as jnp

from benchmarks.common import turns


class Peak(NamedTuple):
  """Highest rates of the machine."""

  flops_per_s: float  # f32 operations of a matrix product
  bytes_per_s: float  # read and written by a copy


class Work(NamedTuple):
  """Operations and memory traffic of a computation."""

  flops: float
  bytes: float  # arguments and results, each once

  def times(self, count: float) -> Work:
    """Returns ``count`` times this work."""
    return Work(count * self.flops, count * self.bytes)

  def seconds(self) -> float:
    """Returns the least time that it takes here."""
    peak = machine_peak()
    return max(self.flops / peak.flops_per_s, self.bytes / peak.bytes_per_s)


def compare(floor_s: float, seconds: float) -> dict[str, float]:
  """Returns the floor, and its share of the measured time, for a report."""
  return {"floor_s": floor_s, "of_floor": floor_s / seconds}


@functools.cache
def machine_peak() -> Peak:
  """Measures the rates once per process; the fastest of some calls counts."""
  size, length = (1024, 2**26) if jax.default_backend() == "cpu" else (8192, 2**30)
  square = jnp.ones((size, size))
  # Larger than any cache, and in place, because fresh memory costs page faults.
  copied = jnp.ones(length)
  with turns.turn():
    product = _fastest(jax.jit(lambda x: square @ x / size), jnp.copy(square))
    copy = _fastest(jax.jit(lambda x: x + 1.0, donate_argnums=0), copied)
  return Peak(2 * size**3 / product, 8 * length / copy)


def _fastest(step: Callable[[Any], Any], carry: Any) -> float:
  seconds = []
  for _ in range(50):
    began = time.perf_counter()
    carry = jax.block_until_ready(step(carry))
    seconds.append(time.perf_counter() - began)
  return min(seconds)


def count(function: Callable[..., Any], *args: Any) -> Work:
  """Counts the work of ``function`` for arguments of these shapes; runs nothing.

  The body of a scan counts once per turn, that of a loop of unknown length once. Calls
  outside XLA, such as C MuJoCo or LAPACK, count as nothing.
  """
  closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
  return Work(_flops(closed), nbytes(args) + nbytes(shapes))


def nbytes(tree: Any) -> int:
  """Returns the bytes of arrays or shapes; random keys count as none."""
  leaves = jax.tree.leaves(tree)
  return sum(x.size * getattr(x.dtype, "itemsize", 0) for x in leaves)


def _flops(closed: core.ClosedJaxpr) -> float:
  total = _flops_of_one_turn(closed)
  for scan in _scans(closed.jaxpr):
    body = scan.params["jaxpr"]
    total += scan.params["length"] * _flops(body) - _flops_of_one_turn(body)
  return total


def _flops_of_one_turn(closed: core.ClosedJaxpr) -> float:
  """Returns JAX's own count, in which every loop turns once."""
  shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in closed.in_avals]
  lowered = jax.jit(core.jaxpr_as_fun(closed)).lower(*shapes)
  cost = lowered.cost_analysis() or {}
  return cost.get("flops", 0.0) + cost.get("transcendentals", 0.0)


def _scans(jaxpr: core.Jaxpr) -> Iterator[core.JaxprEqn]:
  """Yields the outermost scans of a program."""
  for equation in jaxpr.eqns:
    if equation.primitive.name == "scan":
      yield equation
      continue
    for value in jax.tree.leaves(
      list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")
    ):
      if hasattr(value, "eqns"):
        yield from _scans(getattr(value, "jaxpr", value))
