"""Delays of the actions, and periods of the 500 Hz loop, without hardware.

  python -m benchmarks.speed.robot_loop
  python -m benchmarks.speed.robot_loop --policy policy --actions 200
  python -m benchmarks.speed.robot_loop --robot double

The delay of an action is the time from the beginning of its control period until the
control process can read it. On the simulated robot, both frames are drawn on the CPU in
that time. A double's cameras draw at their own rate, and the vendors' clients talk to
its arm and gripper. Only figures of an idle machine mean anything: plant, cameras and
policy share it with the loop.
"""

from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from apnpql_jax.config import files
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import policy_folder, setup
from apnpql_jax.robot.blackboard import PERIOD_BIN_S
from apnpql_jax.robot.episodes import Options
from apnpql_jax.robot.session import Session
from apnpql_jax.testing import SMALL, export_untrained
from benchmarks.common import command

_TRIES = 20


def main() -> None:
  parser = command.parser(__doc__)
  parser.add_argument("--policy", type=Path, help="folder; an untrained one if absent")
  parser.add_argument("--robot", choices=("simulated", "double"), default="simulated")
  parser.add_argument("--actions", type=int, default=1000)
  parser.add_argument("--slowdown", type=float, default=1.0, help="only to try it")
  args = command.parse(parser)
  actions = 20 if args.quick else args.actions
  with tempfile.TemporaryDirectory() as folder:
    path = args.policy or Path(folder) / "policy"
    if args.policy is None:
      agent = SMALL if args.quick else files.load_preset("push_plate").agent
      export_untrained(path, agent)
    result = measure(path, actions, args.robot, args.slowdown)
  name = "robot_loop" + ("_double" if args.robot == "double" else "")
  command.publish(name, args, [result], policy=str(args.policy or "untrained"))


def measure(path: Path, actions: int, kind: str, slowdown: float) -> dict[str, Any]:
  """Returns quantiles of the delays (ms) and of the periods (ms)."""
  policy = policy_folder.load(path)
  described = setup.describe(kind, policy, Path(), slowdown=slowdown)
  delays: dict[tuple[int, int], float] = {}
  periods, stops = 0, []
  with (
    setup.doubled(described) as robot,
    Session(robot, policy, Options()) as session,
  ):
    session.wait_until_ready()
    while len(delays) < actions:
      _go_home(session)
      before = session.board["state"].read()["periods"]
      outcome = session.play(watch=lambda found: _note(delays, found))
      periods = periods + session.board["state"].read()["periods"] - before
      stops.append(outcome.reason)
  found = 1e3 * np.array(list(delays.values()))
  return {
    "robot": kind,
    "actions": len(found),
    "delay_p50_ms": float(np.quantile(found, 0.5)),
    "delay_p99_ms": float(np.quantile(found, 0.99)),
    "delay_max_ms": float(found.max()),
    "beyond_a_period": int((found > 1e3 * policy.contract["control_period_s"]).sum()),
    "cycles": int(np.sum(periods)),
    "period_p50_ms": _quantile(periods, 0.5),
    "period_p99_ms": _quantile(periods, 0.99),
    "period_max_ms": _quantile(periods, 1.0),
    "episodes": {reason: stops.count(reason) for reason in stops},
  }


def _go_home(session: Session) -> None:
  """Goes home; again if a busy machine has stopped the arm on its way."""
  for attempt in range(_TRIES):
    try:
      session.go_home()
      return
    except DeviceError:
      if attempt == _TRIES - 1:
        raise


def _note(delays: dict[tuple[int, int], float], found: Any) -> None:
  """Keeps the delay of a new action, from a record "policy"."""
  if found["actions"] and not found["over"]:
    delays[int(found["order"]), int(found["actions"])] = float(found["delay"])


def _quantile(histogram: Any, share: float) -> float:
  """Returns the upper end of the bin with a quantile, ms."""
  counts = np.cumsum(histogram)
  index = int(np.searchsorted(counts, share * counts[-1]))
  return 1e3 * PERIOD_BIN_S * (index + 1)


if __name__ == "__main__":
  main()
