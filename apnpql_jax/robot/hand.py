"""The gripper as the control process sees and commands it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from apnpql_jax.errors import reason
from apnpql_jax.robot.protocols import Gripper

THERE_RAD = 0.05
"""Distance from its end at which the gripper counts as open or closed, rad."""

_STILL_RAD, _STILL_S = 0.01, 0.5
"""Fingers that move less than this, rad, for this time, s, stand still.

The driver writes its settings for about 0.3 s before the fingers obey the first
command. They must not count as a grip meanwhile.
"""


class Hand:
  """A gripper, what it was told last, and whether its fingers move."""

  def __init__(self, gripper: Gripper, *, open_rad: float, closed_rad: float):
    """Reads the first state; the angles are those of an open and a closed gripper."""
    self._gripper, self._open, self._closed = gripper, open_rad, closed_rad
    self.state = gripper.get_observation()
    """The newest measurement."""
    self.error = ""
    """Why the gripper does not work; it stays."""
    self.since = -np.inf
    """When the command to the gripper last changed."""
    self._close: bool | None = None
    self._place, self._moved = self.state.angle, -np.inf

  def look(self, now: float) -> None:
    """Reads the gripper."""
    self.state = self._try(self._gripper.get_observation) or self.state
    if abs(self.state.angle - self._place) > _STILL_RAD:
      self._place, self._moved = self.state.angle, now

  def move(self, now: float, close: bool) -> None:
    """Closes or opens the gripper."""
    if close != self._close:
      self._close, self.since, self._moved = close, now, now
      self._try(self._gripper.send_action, close)

  def hold(self, now: float) -> None:
    """Stops the fingers where they are, but keeps a grip.

    Fingers that were told to close and have stopped are pressing on an object, or on
    each other, with their limited torque. They keep pressing, because commanding their
    present position would take away the force that carries the object.
    """
    grips = self._close and now - self._moved > _STILL_S
    if self._close is not None and not grips:
      self._close = None
      self._try(self._gripper.hold)

  def is_at(self, close: bool) -> bool:
    """Returns whether the gripper is closed, or open."""
    angle = self.state.angle
    if close:
      return angle >= self._closed - THERE_RAD
    return angle <= self._open + THERE_RAD

  def _try(self, call: Callable[..., Any], *args: Any) -> Any:
    """Returns what a call of the driver returns; keeps the first error."""
    try:
      return call(*args)
    except Exception as error:  # Whatever the driver raises stops the motion.
      line = reason(error).removeprefix("gripper: ")
      self.error = self.error or f"gripper: {line}"
