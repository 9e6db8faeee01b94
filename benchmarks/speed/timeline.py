"""Time line of an update: where its time goes, by part of the agent.

  python -m benchmarks.speed.timeline --store

Updates as in ``speed.learner``, traced by JAX's profiler. Every operation of the
program belongs to the module, or to the function of JAX, in which it was written. Its
time is the sum over threads, waiting for data of other operations included, so the
parts add up to more than the update on several threads. Run it on one core
(``taskset -c 0``) to see the work alone.
"""

import argparse
import collections
from collections.abc import Iterator
from pathlib import Path
import re
import tempfile
from typing import Any

import jax

from apnpql_jax.config.schema import TrainConfig
from benchmarks.common import command, noise, settings, timing
from benchmarks.speed import learner

Result = dict[str, Any]

_OPERATION = re.compile(r'%([\w.-]+) = .*metadata=\{[^}]*op_name="([^"]*)"')
# Parts of the names of operations: scopes of the learner, modules, functions of JAX.
_STEPS = ("augment", "bellman_target", "total_loss", "apply_gradients")
_MODULES = ("global_image", "wrist_image", "Encoder", "ValueHead", "MLP")
_RANDOM = ("normal", "uniform", "threefry")


def main() -> None:
  parser = command.parser(__doc__, repeats=3)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, default=64)
  parser.add_argument("--candidates", type=int, default=120)
  args = command.parse(parser)
  config = settings.preset(args.preset, quick=args.quick)
  if args.quick:
    args.batch, args.candidates = 8, 8
  config = settings.changed(config, "replay", batch_size=args.batch)
  precision = config.agent.candidate_precision
  config = settings.with_candidates(config, args.candidates, precision)
  header = {name: getattr(args, name) for name in ("preset", "batch", "candidates")}
  header["candidate_precision"] = precision
  command.publish("timeline", args, measure_all(config, args), **header)


def measure_all(config: TrainConfig, args: argparse.Namespace) -> Iterator[Result]:
  """Yields the time of each part of an update, the longest first."""
  agent = learner.make_agent(config.agent)
  ready = learner.prepare(agent, noise.transitions(config))
  updates = ready.units * args.repeats
  times = timing.measure({"": ready}, repeats=args.repeats)[""]
  parts: dict[str, float] = collections.defaultdict(float)
  origin = dict(_OPERATION.findall(text_of(ready)))
  for operation, seconds in traced(ready, args.repeats, origin):
    parts[part_of(operation)] += seconds
  total = sum(parts.values())
  for part, seconds in sorted(parts.items(), key=lambda item: -item[1]):
    yield {"part": part, "ms": 1e3 * seconds / updates, "share": seconds / total}
  yield {"part": "an update, by the clock", "ms": 1e3 * times.seconds}


def text_of(ready: timing.Ready) -> str:
  """Returns the compiled program as text."""
  program: Any = ready.run  # A partial call of what was compiled.
  return program.func.as_text()


def traced(
  ready: timing.Ready, calls: int, origin: dict[str, str]
) -> Iterator[tuple[str, float]]:
  """Yields (where an operation was written, seconds) of ``calls`` of a program.

  ``origin`` maps the names of operations to where they were written.
  """
  with tempfile.TemporaryDirectory() as folder:
    with jax.profiler.trace(folder):
      for _ in range(calls):
        jax.block_until_ready(ready.run())
    (path,) = Path(folder).rglob("*.xplane.pb")
    data = jax.profiler.ProfileData.from_file(str(path))
  for plane in data.planes:
    for event in (event for line in plane.lines for event in line.events):
      # A loop contains the operations of its body.
      if event.name in origin and not event.name.startswith("while"):
        yield origin[event.name], event.duration_ns / 1e9


def part_of(operation: str) -> str:
  """Returns the part of the agent that a path of JAX's names belongs to."""
  step = next((x for x in _STEPS if x in operation), "rest")
  module = next((x for x in _MODULES if x in operation), "")
  if not module and any(x in operation for x in _RANDOM):
    module = "random numbers"
  direction = "backward" if "transpose(" in operation else ""
  return ", ".join(x for x in (step, module, direction) if x)


if __name__ == "__main__":
  main()
