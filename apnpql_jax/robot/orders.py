"""Orders of the main process to the control process."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

from apnpql_jax.robot.blackboard import Blackboard, Phase

_LOOK_S = 0.01  # Between two looks at the board.


class Orders:
  """The newest order, and what has become of it."""

  def __init__(self, board: Blackboard):
    """Begins without an order."""
    self._board, self._number = board, 0

  def give(self, phase: Phase, **fields: Any) -> int:
    """Publishes an order and returns its number; see the record "order"."""
    self._number += 1
    self._board["order"].write({"number": self._number, "phase": phase, **fields})
    return self._number

  @property
  def obeyed(self) -> bool:
    """Whether the control process follows the order."""
    return bool(self._board["state"].read()["number"] == self._number)

  @property
  def done(self) -> bool:
    """Whether the order's motion has ended; after a fault, the arm may still brake."""
    state = self._board["state"].read()
    return bool(state["number"] == self._number and state["done"])


def comes_true(condition: Callable[[], bool], seconds: float) -> bool:
  """Waits until a condition holds; returns whether it does in time."""
  until = time.monotonic() + seconds
  while not condition():
    if time.monotonic() > until:
      return False
    time.sleep(_LOOK_S)
  return True
