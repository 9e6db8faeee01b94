"""Training on push_plate from pixels for a short time, to see that it works.

  python -m benchmarks.gpu.training --seconds 60

Runs `apnpql train` with more worlds and a larger batch than the preset of the CPU. An
environment step still has 16 transitions in updates.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
import statistics
import tempfile
import time
from typing import Any

from apnpql_jax import testing
from benchmarks.common import command, turns
from benchmarks.speed import compile_time

OPTIONS = (
  "--backend mjx --env.worlds 512 --replay.batch-size 512 --updates-per-iteration 64 "
  "--replay.capacity 51200 --replay.expert-steps 25600 --eval-every 1000000000 "
  "--checkpoint-every 1000000000 --no-video"
).split()
ENDLESS = ["--total-steps", "1000000000"]


def main() -> None:
  parser = command.parser(__doc__)
  parser.add_argument("--seconds", type=float, default=45, help="after an iteration")
  args = command.parse(parser)
  args.seconds = 2 if args.quick else args.seconds
  command.publish("training", args, measure(args), preset="push_plate")


def measure(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the figures of a training; others may compile meanwhile, none measures."""
  options = testing.TINY_ARGS if args.quick else OPTIONS
  with turns.turn(shared=True), tempfile.TemporaryDirectory() as name:
    run = Path(name) / "run"
    with compile_time.training(["push_plate", *options, *ENDLESS], run) as started:
      time.sleep(args.seconds)
      rows = [row for row in testing.rows(run) if "loss/q" in row]
  figures = {
    "steps_per_s": statistics.median(row["time/sps_e2e"] for row in rows),
    "updates_per_s": statistics.median(row["time/updates_per_s"] for row in rows),
  }
  for key in (
    "rollout/successes",
    "rollout/timeouts",
    "faults/updates",
    "faults/worlds",
  ):
    figures[key] = sum(row[key] for row in rows)
  yield {"first_iteration_s": started, "env_steps": rows[-1]["step"], **figures}


if __name__ == "__main__":
  main()
