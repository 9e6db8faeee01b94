"""Seconds from the training command to its first iteration, without and with a cache.

  python -m benchmarks.speed.compile_time --store --backends native --tasks push_plate

Each start is a new process. The cold one finds an empty compilation cache, the warm one
what the cold one left there. Both find the bank of reset states. Replays hold only 8
control periods, so that the figures consist of the imports, which are also timed alone,
compilation, a short play of the expert, and one iteration.
"""

import argparse
from collections.abc import Generator, Iterator
import contextlib
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from apnpql_jax import testing
from apnpql_jax.config.checks import BACKENDS
from apnpql_jax.config.files import load_preset
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.tasks import make_task, task_names
from benchmarks.common import command, settings, store, timing

PERIODS, PATIENCE_S = 8, 1800.0
"""Control periods of each world that both replays hold; longest start."""


def main() -> None:
  parser = command.parser(__doc__, repeats=2)
  tasks = task_names()
  parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks)
  engines = settings.ENGINES
  parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=engines)
  args = command.parse(parser)
  if args.quick:
    args.tasks, args.backends, args.repeats = ["push_plate"], ["native"], 1
  command.publish("compile_time", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the figures of every setting, one after the other."""
  import_seconds()  # Fills the cache of the disk.
  imports = [import_seconds() for _ in range(max(3, args.repeats))]
  for task, backend in itertools.product(args.tasks, args.backends):
    options = testing.TINY_ARGS if args.quick else short(task)
    start = [task, *options, "--backend", backend]
    starts = [cold_and_warm(start) for _ in range(args.repeats)]
    cold, warm = zip(*starts, strict=True)
    kinds = {"cold": cold, "warm": warm, "imports": imports}
    figures = {kind: timing.spread("seconds", x) for kind, x in kinds.items()}
    yield {"task": task, "backend": backend, **figures}


def short(task: str) -> list[str]:
  """Builds the reset bank; returns options that shorten a preset, not its programs."""
  config = load_preset(task)
  load_bank(make_task(config.env.task), config.env.bank_rows)
  slots = str(PERIODS * config.env.worlds)
  return ["--replay.capacity", slots, "--replay.expert-steps", slots, "--no-video"]


def cold_and_warm(args: list[str]) -> tuple[float, float]:
  """Returns the seconds to the first iteration of two starts that share a cache."""
  with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache")}
    with training(args, folder / "cold", **cache) as cold:
      pass
    with training(args, folder / "warm", **cache) as warm:
      pass
  return cold, warm


@contextlib.contextmanager
def training(args: list[str], run: Path, **env: str) -> Generator[float]:
  """Runs ``apnpql train`` until the context ends.

  Yields:
    seconds from the command to the first row of metrics.

  Raises:
    RuntimeError: The process ended early or took too long; the message holds its last
      output.
  """
  command = [sys.executable, "-m", "apnpql_jax", "train", *args, "--run", str(run)]
  output, began = run.with_suffix(".txt"), time.monotonic()
  env = environment() | env
  with output.open("wb") as file:
    process = subprocess.Popen(command, env=env, stdout=file, stderr=file)
  try:
    while not testing.rows(run):
      if process.poll() is not None or time.monotonic() - began > PATIENCE_S:
        raise RuntimeError(output.read_text(errors="replace")[-2000:])
      time.sleep(0.02)
    yield time.monotonic() - began
  finally:
    # Not killed, because JAX may still be writing to the cache.
    process.send_signal(signal.SIGTERM)
    process.wait()


def import_seconds() -> float:
  """Times a process that only imports what training needs."""
  began = time.monotonic()
  code = "import apnpql_jax.training.train"
  subprocess.run([sys.executable, "-c", code], env=environment(), check=True)
  return time.monotonic() - began


def environment() -> dict[str, str]:
  """Returns an environment in which a process finds the checkout's package."""
  return os.environ | {"PYTHONPATH": str(store.ROOT)}


if __name__ == "__main__":
  main()
