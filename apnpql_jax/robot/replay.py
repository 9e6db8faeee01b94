"""Actions of a log, to repeat them on a robot.

Nothing in the numbers tells a velocity from a joint angle. So a log must agree with the
contract of the policy in whose place it acts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.data import lerobot
from apnpql_jax.errors import FileError
from apnpql_jax.robot.player import Act

Json = dict[str, Any]

_MEANING = ("order", "meaning", "units", "low", "high")
"""What must be the same about actions, see ``deploy.contract``."""

_TOLERANCE = 1e-3  # of a control period, and of an action beyond its range


def recorded_actions(folder: Path, contract: Json) -> list[np.ndarray]:
  """Returns the actions of each episode of a log, f64[n, 7].

  Args:
    folder: A log of ``apnpql robot run``.
    contract: That of the policy.

  Raises:
    ConfigError: A package is missing.
    FileError: It is not a log, or differs from the contract; the message names the
      difference.
  """
  dataset = lerobot.read(folder)
  actions = [np.asarray(episode.actions, float) for episode in dataset.episodes]
  if not actions:
    raise FileError(f"{str(folder)!r} has no episodes")
  difference = _difference(dataset, contract) or _beyond(actions, contract)
  if difference:
    raise FileError(f"{str(folder)!r} cannot be replayed: {difference}")
  return actions


def replaying(actions: Sequence[np.ndarray]) -> Act:
  """Returns a policy that repeats recorded episodes; then it stands still."""

  def act(observation: dict[str, np.ndarray], episode: int, instant: int) -> np.ndarray:
    del observation
    recorded = actions[episode % len(actions)]
    if instant < len(recorded):
      return np.asarray(recorded[instant])
    return np.append(np.zeros(6), recorded[-1][6])

  return act


def _difference(dataset: Any, contract: Json) -> str:
  """Returns the first difference between a log and a contract, or an empty string."""
  wanted, period = contract["action"], contract["control_period_s"]
  if abs(1 / dataset.fps / period - 1) > _TOLERANCE:
    return f"its actions are {1 / dataset.fps:.4g} s apart, the policy's {period} s"
  for task in (episode.task for episode in dataset.episodes):
    if task != contract["task"]:
      return f"its task is {task!r}, the policy's {contract['task']!r}"
  names = dataset.names.get(lerobot.ACTION)
  if names != wanted["order"]:
    return f"its actions are of {names}, the policy's of {wanted['order']}"
  own = _actions_of(dataset.about.get("contract"))
  if own is None:
    return "it has no contract with the meaning of its actions, as logs of apnpql have"
  for key in _MEANING:
    if own.get(key) != wanted[key]:
      return f"{key} of its actions: {own.get(key)!r}; of the policy's: {wanted[key]!r}"
  return ""


def _actions_of(contract: Any) -> Json | None:
  """Returns the entry of the actions, if there is one."""
  found = contract.get("action") if isinstance(contract, dict) else None
  return found if isinstance(found, dict) else None


def _beyond(actions: list[np.ndarray], contract: Json) -> str:
  """Returns which action is outside of the contract's range, or an empty string."""
  low, high = (np.array(contract["action"][key]) for key in ("low", "high"))
  found = np.concatenate(actions)
  outside = (found < low - _TOLERANCE) | (found > high + _TOLERANCE)
  if not outside.any():  # NaN is not: the robot holds there, as it did.
    return ""
  row, column = np.argwhere(outside)[0]
  name, value = contract["action"]["order"][column], found[row, column]
  return (
    f"an action of {name} is {value:.3g}, outside of {low[column]:g} to "
    f"{high[column]:g}"
  )
