"""What the benchmarks share: their command line, how they time, and their report.

Compilation is timed apart: it is what this process waited, which is little where the
persistent cache holds the program (``compile_time.py`` empties it). A repeat runs until
everything is ready, as often as fills ``SECONDS``. What is compared is timed in turns,
one repeat of each, so that a minute in which the machine is slow meets all of it.
Figures are medians over repeats, with the lowest and the highest.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
import json
import math
import statistics
import time
from typing import Any

from apnpql_jax import devices

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import tables

SECONDS = 0.5
"""Of work per repeat, at least."""


@dataclasses.dataclass(frozen=True)
class Times:
  """Seconds of a call, or of one of the things it does, in every repeat."""

  wall: Sequence[float]
  cpu: Sequence[float]

  @property
  def seconds(self) -> float:
    """The median of the wall clock."""
    return statistics.median(self.wall)

  def per(self, count: int) -> Times:
    """Those of one of the ``count`` things that a call does."""
    return Times([x / count for x in self.wall], [x / count for x in self.cpu])

  def rate(self, name: str) -> dict[str, float]:
    """Things per second for the report; their CPU time tells whether the machine was
    at work on something else."""
    return {
      f"{name}s_per_s": 1.0 / self.seconds,
      f"{name}s_per_s_low": 1.0 / max(self.wall),
      f"{name}s_per_s_high": 1.0 / min(self.wall),
      f"cpu_us_per_{name}": 1e6 * statistics.median(self.cpu),
    }


@dataclasses.dataclass(frozen=True)
class Ready:
  """A run that is compiled and waits to be timed."""

  run: Callable[[], Any]
  """Returns all arrays that it computes."""

  floor_s: float
  """The least seconds of one of the things that it does."""

  things: int = 1
  """That it does, such as updates."""

  compile_s: float = 0.0

  def figures(self, name: str, times: Times) -> dict[str, float]:
    """Things per second for the report; see ``measure``."""
    return {
      **times.rate(name),
      "compile_s": self.compile_s,
      **floor.compare(self.floor_s, times.seconds),
    }


def spread(seconds: Sequence[float]) -> dict[str, float]:
  """Seconds of all repeats for the report."""
  return {
    "seconds": statistics.median(seconds),
    "seconds_low": min(seconds),
    "seconds_high": max(seconds),
  }


class Carried:
  """A run that goes on from where its last call stopped."""

  def __init__(self, step: Callable[[Any], tuple[Any, Any]], carry: Any):
    """``step`` is as for ``lax.scan`` and may donate what it is given."""
    self._step, self.carry = step, carry

  def __call__(self) -> Any:
    """One step on; returns all that was computed."""
    self.carry, out = self._step(self.carry)
    return self.carry, out

  def again(self) -> Any:
    """The same step every time, if it donates nothing; returns all of it."""
    return self._step(self.carry)


def compiled(
  jitted: Any, *args: Any, options: Mapping[str, Any] | None = None
) -> tuple[Any, float]:
  """What a jitted function compiles to for these arguments, and the seconds it took.

  Args:
    jitted: the function.
    args: its arguments.
    options: of XLA, on top of its own.

  Raises:
    ConfigError: it would need more memory than there is.
  """
  began = time.perf_counter()
  program = jitted.lower(*args).compile(compiler_options=options)
  seconds = time.perf_counter() - began
  if (sizes := program.memory_analysis()) is not None:
    new = sizes.output_size_in_bytes - sizes.alias_size_in_bytes
    devices.check_memory(sizes.temp_size_in_bytes + new, "the program")
  return program, seconds


def measure(
  ready: Sequence[Ready], *, repeats: int, seconds: float = SECONDS
) -> list[Times]:
  """Times runs in turns.

  Args:
    ready: the runs.
    repeats: how often each is timed, after two calls that are not.
    seconds: least time of a repeat.

  Returns:
    for each run the times of one of the things that it does.
  """
  calls = []
  for each in ready:
    _time(each.run, 1)
    calls.append(max(1, math.ceil(seconds / _time(each.run, 1)[0])))
  rounds = [
    list(map(_time, (each.run for each in ready), calls)) for _ in range(repeats)
  ]
  return [
    Times(*zip(*pairs, strict=True)).per(count * each.things)
    for each, count, pairs in zip(ready, calls, zip(*rounds, strict=True), strict=True)
  ]


def _time(run: Callable[[], Any], calls: int) -> tuple[float, float]:
  """Seconds of the wall clock and of the CPU."""
  began, began_cpu = time.perf_counter(), time.process_time()
  for _ in range(calls):
    jax.block_until_ready(run())
  return time.perf_counter() - began, time.process_time() - began_cpu


def parser(doc: str | None, *, repeats: int = 5) -> argparse.ArgumentParser:
  """The options that all benchmarks have; ``doc`` is the module's docstring."""
  options = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
  options.add_argument("--json", action="store_true", help="print one JSON object")
  options.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
  options.add_argument("--store", action="store_true", help="keep the JSON in results")
  options.add_argument("--repeats", type=int, default=repeats)
  return options


def parse(options: argparse.ArgumentParser) -> argparse.Namespace:
  """Reads the command line; whoever is quick repeats twice only."""
  args = options.parse_args()
  if args.quick and args.store:
    options.error("--quick figures mean nothing; nothing is stored")
  args.repeats = 2 if args.quick else args.repeats
  return args


def publish(
  name: str,
  args: argparse.Namespace,
  results: Iterable[dict[str, Any]],
  **header: Any,
) -> None:
  """Prints and stores results as they come: what is measured, a crash cannot take."""
  report: dict[str, Any] = {
    "benchmark": name,
    **tables.machine(),
    "peak": floor.machine_peak()._asdict(),
    "repeats": args.repeats,
    **header,
    "results": [],
  }
  for result in results:
    report["results"].append(result)
    if not args.json:
      print(json.dumps(result), flush=True)
    if args.store:
      tables.store(name, report)
  if args.json:
    print(json.dumps(report))
