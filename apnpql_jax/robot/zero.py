"""When the force sensor may be zeroed: only while nothing presses on the hand.

Zeroing makes a sensor report no force, so it hides whatever presses on the hand at that
moment. A controller does not report how large the force was. So:

- Before the first motion of a session the sensor is zeroed whatever it reads, because
  its offset since power-on is not known.
- Before each episode, in the neutral pose, it is zeroed again, but only if it reads no
  more than a free hand may. The reading shows what presses on the hand. It shows what
  did so at the zero before, too, with the opposite sign.
- On the way home the last zero stays, so that a hand that presses at the end of an
  episode is felt.

A force that stays on the hand from the first zero to the neutral pose is not found.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from apnpql_jax.robot.protocols import Arm
from apnpql_jax.robot.sensor import load

_READINGS = 50
"""Number of readings that are averaged at most: 0.1 s."""


class Zero:
  """Zeroes a sensor where that is safe."""

  def __init__(self) -> None:
    """Begins with a sensor whose offset is not known."""
    self._readings: deque[np.ndarray] = deque(maxlen=_READINGS)
    self._known = False

  def note(self, wrench: np.ndarray) -> None:
    """Takes the reading of a cycle, f64[6] in N and N m."""
    self._readings.append(wrench)

  def start(self, arm: Arm, *, again: bool) -> str:
    """Lets an arm at rest follow commands.

    Args:
      arm: The arm.
      again: Zeroes the sensor even if that has been done.

    Returns:
      Why the sensor must not be zeroed, or an empty string. The arm does not follow
      commands then.
    """
    refusal = self._refusal() if again and self._known else ""
    if not refusal:
      arm.start(zero=again or not self._known)
      self._known = True
      self._readings.clear()  # Those before the zero; the same cycle adds a new one.
    return refusal

  def _refusal(self) -> str:
    mean = np.mean(self._readings, axis=0)
    if load(mean) <= 1:
      return ""
    force, torque = np.linalg.norm(mean.reshape(2, 3), axis=1)
    return (
      f"the arm reads {force:.0f} N and {torque:.1f} N m at rest before zeroing: free "
      "the hand, or check the payload in robot.toml"
    )
