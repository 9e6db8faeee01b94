"""Seconds from the training command to its first iteration, without and with a cache.

  python benchmarks/compile_time.py --quick
  python benchmarks/compile_time.py --store --backends native --tasks push_plate

Each start is a process of its own. The cold one finds an empty compilation cache, the
warm one what the cold one left there; both find the bank of reset states. Replays are
cut short, so that little else than compilation is in the figures: 8 periods of the
expert, the first iteration, and the imports, which are also timed alone, as no start
can take less. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import settings
import tables

from apnpql_jax import testing
from apnpql_jax.config.checks import BACKENDS
from apnpql_jax.config.files import load_preset
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names

PERIODS = 8
"""Control periods of each world that both replays hold."""

PATIENCE_S = 1800.0


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__, repeats=2)
  tasks = task_names()
  parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
  parser.add_argument(
    "--backends", nargs="+", choices=BACKENDS, default=settings.ENGINES
  )
  args = timing.parse(parser)
  if args.quick:
    args.tasks, args.backends, args.repeats = ["push_plate"], ["native"], 1
  timing.publish("compile_time", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Figures of every setting, one after the other."""
  import_seconds()  # From the disk.
  imports = [import_seconds() for _ in range(max(3, args.repeats))]
  for task, backend in itertools.product(args.tasks, args.backends):
    options = testing.TINY_ARGS if args.quick else short(task)
    command = ["train", task, *options, "--backend", backend]
    starts = [cold_and_warm(command) for _ in range(args.repeats)]
    cold, warm = zip(*starts, strict=True)
    yield {
      "task": task,
      "backend": backend,
      "cold": timing.spread(cold),
      "warm": timing.spread(warm),
      "imports": timing.spread(imports),
    }


def short(task: str) -> list[str]:
  """Options that leave of a preset what is compiled; its bank is built beforehand."""
  config = load_preset(task)
  load_bank(make_task(config.env.task), config.env.bank_rows)
  slots = str(PERIODS * config.env.worlds)
  return ["--replay.capacity", slots, "--replay.expert-steps", slots, "--no-video"]


def cold_and_warm(command: list[str]) -> tuple[float, float]:
  """Seconds until the first iteration is done, of two starts with one cache."""
  with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    env = environment() | {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    cold, warm = (start(command, folder / run, env) for run in ("cold", "warm"))
  return cold, warm


def start(command: list[str], run: Path, env: dict[str, str]) -> float:
  """Trains until the first row of metrics is there; returns the seconds it took."""
  said = run.with_suffix(".txt")
  began = time.monotonic()
  with said.open("wb") as file:
    process = subprocess.Popen(
      [sys.executable, "-m", "apnpql_jax", *command, "--run", str(run)],
      env=env,
      stdout=file,
      stderr=file,
    )
  while not testing.rows(run):
    if process.poll() is not None or time.monotonic() - began > PATIENCE_S:
      process.kill()
      raise RuntimeError(said.read_text(errors="replace")[-2000:])
    time.sleep(0.02)
  seconds = time.monotonic() - began
  # Not killed: JAX may still be writing to the cache.
  process.send_signal(signal.SIGTERM)
  process.wait()
  return seconds


def import_seconds() -> float:
  """Of a process that only imports what training needs."""
  began = time.monotonic()
  subprocess.run(
    [sys.executable, "-c", "import apnpql_jax.training.train"],
    env=environment(),
    check=True,
  )
  return time.monotonic() - began


def environment() -> dict[str, str]:
  """In which a process finds the checkout's package."""
  return os.environ | {"PYTHONPATH": str(tables.ROOT)}


if __name__ == "__main__":
  main()
