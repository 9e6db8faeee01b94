"""Timing of compiled programs.

Compilation is timed apart. It is the time that this process waits, which is short
where the persistent cache holds the program. A repeat calls a program as often as fills
``SECONDS`` and waits for every result. Programs that are compared take turns, one
repeat of each, so that a slow minute of the machine affects all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import math
import statistics
import time
from typing import Any, TypeVar

import jax

from apnpql_jax import devices
from benchmarks.common import floor, turns

SECONDS = 0.5  # least duration of a repeat

Key = TypeVar("Key")


@dataclasses.dataclass(frozen=True)
class Times:
  """Seconds of one call, or of one unit of its work, in every repeat."""

  wall: Sequence[float]
  cpu: Sequence[float]

  @property
  def seconds(self) -> float:
    """Median of the wall clock."""
    return statistics.median(self.wall)

  def per(self, count: int) -> Times:
    """Returns the times of one of ``count`` equal units."""
    return Times([x / count for x in self.wall], [x / count for x in self.cpu])

  def rate(self, unit: str) -> dict[str, float]:
    """Returns units per second; the CPU time shows whether the machine was busy."""
    cpu_us = {f"cpu_us_per_{unit}": 1e6 * statistics.median(self.cpu)}
    return spread(f"{unit}s_per_s", [1.0 / x for x in self.wall]) | cpu_us


@dataclasses.dataclass(frozen=True)
class Ready:
  """A compiled program that waits to be timed."""

  run: Callable[[], Any]  # returns all arrays that it computes
  floor_s: float | None  # least seconds of a unit of its work; None if not counted
  units: int = 1  # of work per call, such as updates
  compile_s: float = 0.0

  def figures(self, unit: str, times: Times) -> dict[str, float]:
    """Returns the rate, the compilation and the share of the limit for a report."""
    limit = {} if self.floor_s is None else floor.compare(self.floor_s, times.seconds)
    return {**times.rate(unit), "compile_s": self.compile_s, **limit}


class Carried:
  """A program that continues from where its last call stopped."""

  def __init__(self, step: Callable[[Any], tuple[Any, Any]], carry: Any):
    """Binds a step, as for ``lax.scan``; it may donate its argument."""
    self._step, self.carry = step, carry

  def __call__(self) -> Any:
    """Takes one step and returns all arrays it computed."""
    self.carry, out = self._step(self.carry)
    return self.carry, out

  def again(self) -> Any:
    """Repeats the same step, which must not donate, and returns its arrays."""
    return self._step(self.carry)


def compiled(jitted: Any, *args: Any, options: Any = None) -> tuple[Any, float]:
  """Compiles a jitted function for these arguments, with XLA's ``options``.

  Returns:
    the program and the seconds of its compilation.

  Raises:
    ConfigError: The program needs more memory than there is.
  """
  with turns.turn(shared=True):
    began = time.perf_counter()
    program = jitted.lower(*args).compile(compiler_options=options)
    seconds = time.perf_counter() - began
  if (sizes := program.memory_analysis()) is not None:
    new = sizes.output_size_in_bytes - sizes.alias_size_in_bytes
    devices.check_memory(sizes.temp_size_in_bytes + new, "the program")
  return program, seconds


def figures(
  unit: str, ready: Mapping[Key, Ready], *, repeats: int
) -> dict[Key, dict[str, float]]:
  """Times programs in turns and returns the figures of each; see ``Ready.figures``."""
  times = measure(ready, repeats=repeats)
  return {key: each.figures(unit, times[key]) for key, each in ready.items()}


def measure(
  ready: Mapping[Key, Ready], *, repeats: int, seconds: float = SECONDS
) -> dict[Key, Times]:
  """Times programs in turns, after two calls of each that do not count.

  A repeat takes at least so many ``seconds``. Returns the times of a unit of work.
  """
  calls: dict[Key, int] = {}
  taken: dict[Key, list[tuple[float, float]]] = {key: [] for key in ready}
  with turns.turn():
    for key, each in ready.items():
      _time(each.run, 1)
      calls[key] = max(1, math.ceil(seconds / _time(each.run, 1)[0]))
    for _ in range(repeats):
      for key, each in ready.items():
        taken[key].append(_time(each.run, calls[key]))
  return {
    key: Times(*zip(*taken[key], strict=True)).per(calls[key] * each.units)
    for key, each in ready.items()
  }


def spread(name: str, values: Sequence[float]) -> dict[str, float]:
  """Returns median, lowest and highest value for a report."""
  median = statistics.median(values)
  return {name: median, f"{name}_low": min(values), f"{name}_high": max(values)}


def _time(run: Callable[[], Any], calls: int) -> tuple[float, float]:
  """Returns seconds of the wall clock and of the CPU."""
  began, began_cpu = time.perf_counter(), time.process_time()
  for _ in range(calls):
    jax.block_until_ready(run())
  return time.perf_counter() - began, time.process_time() - began_cpu
