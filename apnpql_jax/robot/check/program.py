"""A trial of the policy's program on what the devices measure, at the control period.

It does what the policy process does in an episode, but no arm gets the actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.check.table import Table
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.player import Act, Observer
from apnpql_jax.robot.protocols import Frame

_INSTANTS = 21
"""Actions, of which the first does not count: nothing is warm yet."""

_ACTION = (7,)


@dataclasses.dataclass(frozen=True)
class Senses:
  """Functions that read the devices."""

  joints: Callable[[], np.ndarray]
  """Joint angles f64[6], rad."""

  gripper: Callable[[], float]
  """Angle of the driven finger, rad."""

  frames: Callable[[], Sequence[Frame]]
  """Newest frame of each camera."""


def rest(observation: dict[str, np.ndarray], episode: int, instant: int) -> np.ndarray:
  """Returns an action, in place of a program that cannot be loaded."""
  del observation, episode, instant
  return np.zeros(_ACTION)


def report(table: Table, robot: Robot, seconds: float) -> None:
  """Sets the row of a program by the longest time of an action, s."""
  period = robot.contract["control_period_s"]
  text = f"up to {1e3 * seconds:.1f} ms per action, period {1e3 * period:.0f} ms"
  table.rows["program"] = text
  if seconds > period:
    table.fail("program", f"{text}: use a faster machine, or give it less to do")


def try_out(act: Act, robot: Robot, senses: Senses) -> tuple[float, np.ndarray]:
  """Chooses some actions.

  Returns:
    Longest time of an action, s, and greatest ages of both frames when their action was
    chosen, f64[2], s.

  Raises:
    UserError: An action is not one for this arm, or the program or a device fails.
  """
  clock, observer = robot.clock, Observer(robot.contract)
  period = robot.contract["control_period_s"]
  seconds, ages = [], []
  for instant in range(_INSTANTS):
    begin, frames = clock.now(), senses.frames()
    seen = observer.observe(senses.joints(), senses.gripper(), frames)
    before = clock.now()
    _check(_chosen(act, seen, instant))
    now = clock.now()
    seconds.append(now - before)
    ages.append([now - frame.time for frame in frames])
    clock.sleep(begin + period - now)
  return max(seconds[1:]), np.max(ages[1:], axis=0)


def _chosen(act: Act, seen: dict[str, Any], instant: int) -> np.ndarray:
  try:
    return act(seen, 0, instant)
  except Exception as error:  # Whatever JAX raises for a program it cannot run.
    raise DeviceError(f"it cannot be run: {one_line(error)}") from error


def _check(action: np.ndarray) -> None:
  if action.shape != _ACTION:
    raise DeviceError(f"its action has {action.size} numbers, not {_ACTION[0]}")
  if not np.isfinite(action).all():
    raise DeviceError("its action is not finite")
