"""Zeroing of the force sensor, which is safe only while nothing presses on the hand.

Zeroing makes a sensor report no force, so it hides whatever presses on the hand at that
moment. A controller does not report how large the force was. So:

- Before the first motion of a session the sensor is zeroed whatever it reads, because
  its offset since power-on is not known.
- In the neutral pose, where nothing touches the hand, the sensor must read no more than
  a free hand may. Before each episode, it is then zeroed again. The reading shows what
  presses on the hand, what did so at the zero before, with the opposite sign, and how
  far the sensor has drifted since. It cannot tell these apart.
- On the way home the last zero stays, so that a hand that presses at the end of an
  episode is felt.

A force that stays on the hand from the first zero to the neutral pose is not found. Nor
is drift within an episode, which looks like a contact, before its end.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from apnpql_jax.robot.protocols import Arm
from apnpql_jax.robot.sensor import load

_READINGS = 50
"""Number of readings that are averaged at most: 0.1 s."""


class Zero:
  """Zeroing of a sensor where that is safe."""

  def __init__(self) -> None:
    """Begins with a sensor whose offset is not known."""
    self._readings: deque[np.ndarray] = deque(maxlen=_READINGS)
    self._known = False
    self.unloaded = np.full(6, np.nan)
    """What the hand read at home, f64[6], N and N m; NaN before."""

  def note(self, wrench: np.ndarray) -> None:
    """Takes the reading of a cycle, f64[6] in N and N m."""
    self._readings.append(wrench)

  def forget(self) -> None:
    """Drops all readings, because they are those of a moving arm."""
    self._readings.clear()
    self.unloaded = np.full(6, np.nan)

  @property
  def is_sure(self) -> bool:
    """Whether there are enough readings to judge."""
    return len(self._readings) == _READINGS

  def check(self) -> str:
    """Stores the reading at home; returns why it cannot be that of a free hand."""
    self.unloaded = np.mean(self._readings, axis=0)
    return self._refusal()

  def start(self, arm: Arm, *, again: bool) -> str:
    """Lets an arm at rest follow commands.

    Args:
      arm: The arm.
      again: Whether to zero the sensor even if that has been done.

    Returns:
      Why the sensor must not be zeroed, or an empty string. The arm does not follow
      commands then.
    """
    refusal = self._refusal() if again and self._known else ""
    if not refusal:
      arm.start(zero=again or not self._known)
      self._known = True
      self.forget()  # Those before the zero; the same cycle adds a new one.
    return refusal

  def _refusal(self) -> str:
    mean = np.mean(self._readings, axis=0)
    if load(mean) <= 1:
      return ""
    force, torque = np.linalg.norm(mean.reshape(2, 3), axis=1)
    return (
      f"the arm reads {force:.0f} N and {torque:.1f} N m at rest: free the hand; if it "
      "is free, the sensor has drifted: start again; if that does not help, check the "
      "payload in robot.toml"
    )
