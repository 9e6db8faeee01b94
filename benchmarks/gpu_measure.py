"""How the sections of gpu_suite.py compile, measure and report.

Programs compile in threads, beside those of other sections; measurements come one at a
time, and wait for the compilations up to a moment that the suite sets ("quiet" tells
whether they did). Each figure is a line of JSON at once, so that nothing measured is
lost when the time is over.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
import concurrent.futures
import contextlib
import dataclasses
import fcntl
import json
from pathlib import Path
import statistics
import threading
import time
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import jax

Settings = dict[str, Any]
SLOW_S = 5.0
"""A repeat that takes longer is the last one."""


@dataclasses.dataclass(frozen=True)
class Item:
  """One figure of a section."""

  what: str

  lower: Callable[[], Any]
  """Traces; returns what has a method ``compile``. One thread at a time."""

  args: Callable[[], tuple[Any, ...]]
  """Arguments of the program."""

  per_call: float
  """Units of a call; the figure is units per second."""

  unit: str = "steps"

  look: Callable[[Any], dict[str, Any]] = lambda _: {}
  """What else is to be told of the program's output."""

  carry: bool = False
  """The program donates its first argument and returns its successor first."""


def emit(**line: Any) -> None:
  """One line of the report."""
  print(json.dumps(line), flush=True)


def measure_all(items: Iterable[Item], settings: Settings) -> None:
  """Compiles all items, measures each when it is ready, and reports as it goes."""
  items = list(items)
  emit(plan=[item.what for item in items])
  tracing = threading.Lock()

  def build(item: Item) -> tuple[Any, list[Any], dict[str, float]]:
    with lock(settings, "compile", shared=True):
      with tracing:
        began = time.perf_counter()
        lowered = item.lower()
        traced = time.perf_counter()
      program, compiled = lowered.compile(), time.perf_counter()
      args = list(item.args())
      began_call = time.perf_counter()
      out = jax.block_until_ready(program(*args))
      if item.carry:
        args[0] = out[0]
      seconds = {
        "trace_s": traced - began,
        "compile_s": compiled - traced,
        # Warp compiles here, and the first call is slower than the others anyway.
        "first_call_s": time.perf_counter() - began_call,
      }
      return program, args, seconds

  with concurrent.futures.ThreadPoolExecutor(settings["threads"]) as pool:
    futures = {pool.submit(build, item): item for item in items}
    for future in concurrent.futures.as_completed(futures):
      item = futures[future]
      try:
        program, args, seconds = future.result()
        with measuring(settings) as quiet:
          figures = _measure(item, program, args, settings)
        emit(what=item.what, quiet=quiet, **seconds, **figures)
      except Exception as error:  # One figure must not cost the others.
        reason = (str(error).splitlines() or [""])[0][:300]
        emit(what=item.what, error=f"{type(error).__name__}: {reason}")


def _measure(
  item: Item, program: Any, args: list[Any], settings: Settings
) -> dict[str, Any]:
  rates = []
  for _ in range(settings["repeats"]):
    calls, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < settings["seconds"] or not calls:
      out = jax.block_until_ready(program(*args))
      if item.carry:
        args[0] = out[0]
      calls += 1
    rates.append(calls * item.per_call / spent)
    if spent > SLOW_S:
      break
  name = f"{item.unit}_per_s"
  figures = {
    name: statistics.median(rates),
    f"{name}_low": min(rates),
    f"{name}_high": max(rates),
  }
  return figures | item.look(out) | memory(program)


def memory(program: Any) -> dict[str, float]:
  """GiB of a program's arrays, and the most that the process has held on the device."""
  found = {}
  if (sizes := program.memory_analysis()) is not None:
    bytes_ = sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    found["program_gib"] = (bytes_ + sizes.temp_size_in_bytes) / 2**30
  stats = jax.local_devices()[0].memory_stats() or {}
  if "peak_bytes_in_use" in stats:
    found["peak_gib"] = stats["peak_bytes_in_use"] / 2**30
  return found


@contextlib.contextmanager
def measuring(settings: Settings) -> Generator[bool, None, None]:
  """The device for oneself; true if nobody compiles meanwhile."""
  with lock(settings, "compile", until=settings["compile_until"]) as quiet:
    with lock(settings, "device"):
      yield quiet


@contextlib.contextmanager
def lock(
  settings: Settings, name: str, *, shared: bool = False, until: float | None = None
) -> Generator[bool, None, None]:
  """A lock between processes and threads; false if it was not free ``until`` then."""
  kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
  with (Path(settings["folder"]) / name).open("w") as file:
    while True:
      try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
      except BlockingIOError:
        if until is not None and time.time() > until:
          yield False
          return
        time.sleep(0.05)
        continue
      yield True
      return
