"""Time line of MJX's physics: where a control period goes, by function of MJX.

  python -m benchmarks.speed.physics_timeline --store

The robot holds still at reset states, and JAX's profiler traces the period. Every
operation of the program belongs to the functions of MJX in which it was written. Times
are sums over threads, as in ``speed.timeline``.
"""

import argparse
import collections
from collections.abc import Iterator
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim import physics
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.tasks import make_task
from apnpql_jax.tasks.contact_report import SUBSTEPS
from benchmarks.common import command, timing
from benchmarks.speed.timeline import text_of, traced

Result = dict[str, Any]

_OPERATION = re.compile(r"%([\w.-]+) = .*metadata=\{[^}]*stack_frame_id=(\d+)")
_SUBSTEP = "MjxPhysics._substep"
_DEPTH = 2  # functions of MJX in the name of a part


def main() -> None:
  parser = command.parser(__doc__, repeats=3)
  parser.add_argument("--task", default="place_plate")
  parser.add_argument("--worlds", type=int, default=32)
  args = command.parse(parser)
  if args.quick:
    args.task, args.worlds = "push_plate", 2
  header = {"task": args.task, "worlds": args.worlds}
  command.publish("physics_timeline", args, measure_all(args), **header)


def measure_all(args: argparse.Namespace) -> Iterator[Result]:
  """Yields the time of each part of a period of all worlds, the longest first."""
  task = make_task(args.task)
  draw = task.sample_resets(np.random.default_rng(0), args.worlds)
  state = physics.initial_state(task.scene, *jax.tree.map(jnp.asarray, draw))
  engine = MjxPhysics(task.scene, substeps=1 if args.quick else SUBSTEPS)
  still = jnp.zeros((args.worlds, 6)), jnp.zeros(args.worlds)
  run, _ = timing.compiled(jax.jit(engine.step), state, *still)
  ready = timing.Ready(functools.partial(run, state, *still), None)
  times = timing.measure({"": ready}, repeats=args.repeats)[""]
  parts: dict[str, float] = collections.defaultdict(float)
  origin = functions(text_of(ready), _SUBSTEP)
  for part, seconds in traced(ready, args.repeats, origin):
    parts[part] += seconds
  total = sum(parts.values())
  for part, seconds in sorted(parts.items(), key=lambda item: -item[1]):
    yield {"part": part, "ms": 1e3 * seconds / args.repeats, "share": seconds / total}
  yield {"part": "a period, by the clock", "ms": 1e3 * times.seconds}


def functions(program: str, caller: str) -> dict[str, str]:
  """Returns the functions in which every operation was written, outermost first.

  Args:
    program: Text of a compiled program of XLA, with its table of stack frames.
    caller: The function whose calls come first. What it does itself is "rest".
  """
  names = _table(program, "FunctionNames", r'"(.*)"')
  locations = _table(program, "FileLocations", r"function_name_id=(\d+)")
  places = _table(program, "StackFrames", r"file_location_id=(\d+)")
  parents = _table(program, "StackFrames", r"parent_frame_id=(\d+)")

  @functools.cache
  def path(frame: str) -> tuple[str, ...]:
    if frame not in places:
      return ()
    above = path(str(int(parents[frame]) - 1))  # 0 stands for none.
    return *above, names[locations[places[frame]]]

  found = {}
  for operation, frame in _OPERATION.findall(program):
    calls = path(frame)
    calls = calls[calls.index(caller) + 1 :] if caller in calls else ()
    named = [name for name in calls if "<locals>" not in name]
    found[operation] = " / ".join(named[:_DEPTH]) or "rest"
  return found


def _table(program: str, title: str, value: str) -> dict[str, str]:
  """Returns the rows of one of the tables before a program: number -> value."""
  _, _, rest = program.partition(f"\n{title}\n")
  rows = rest.partition("\n\n")[0].splitlines()
  found = [re.match(rf"(\d+) .*?{value}", row) for row in rows]
  return {x[1]: x[2] for x in found if x}


if __name__ == "__main__":
  main()
