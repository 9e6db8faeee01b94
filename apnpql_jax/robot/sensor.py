"""The force-torque sensor of the tool flange: its error, and a simulated one.

The data sheet of the UR5e gives an accuracy of 4 N and 0.3 N m. Assumed here: each axis
of a zeroed sensor is off by at most that, which covers drift since the zero and the
errors of payload and posture. So the error of a free hand's reading has a norm of up
to sqrt(3) 4 N = 6.9 N and sqrt(3) 0.3 N m = 0.52 N m, as all axes may be off at once.
"""

from __future__ import annotations

import numpy as np

FORCE_ACCURACY, TORQUE_ACCURACY = 4.0, 0.3
"""Largest error of an axis, N and N m (data sheet of the UR5e)."""

FREE_FORCE, FREE_TORQUE = 7.5, 0.6
"""What a free hand reads at most, as a norm, in N and N m.

The error of the module's docstring, and 0.6 N and 0.08 N m for noise: three standard
deviations of the noise of ``Sensor`` after the filter of the virtual arm.
"""

NOISE = np.repeat([0.5, 0.05], 3)
"""Standard deviation of each reading of a simulated sensor, N and N m; a guess."""

POWER_ON = 3.0
"""Offset of a simulated sensor that has not been zeroed, in accuracies; a guess."""


def load(wrench: np.ndarray) -> float:
  """Returns a wrench f64[6] relative to what a free hand may read; above 1: contact."""
  force, torque = np.linalg.norm(wrench.reshape(2, 3), axis=1)
  return float(max(force / FREE_FORCE, torque / FREE_TORQUE))


class Sensor:
  """A simulated sensor with an offset and noise; wrenches are f64[6], N and N m."""

  def __init__(
    self, rng: np.random.Generator, *, error: float = 1.0, noise: float = 1.0
  ) -> None:
    """Draws the offset that the sensor has before its first zero.

    Args:
      rng: Generator of errors and noise.
      error: Largest error of an axis, in accuracies.
      noise: Standard deviation of the noise, in multiples of ``NOISE``.
    """
    self._rng, self._most, self._noise = rng, error, noise * NOISE
    self._offset = POWER_ON * self._error()

  def zero(self, wrench: np.ndarray) -> None:
    """Makes the present ``wrench`` read as zero, up to a random error."""
    self._offset = self._error() - wrench

  def drift(self, wrench: np.ndarray) -> None:
    """Moves the zero by ``wrench``, as warming up does."""
    self._offset = self._offset + wrench

  def read(self, wrench: np.ndarray) -> np.ndarray:
    """Returns a reading of the true ``wrench``."""
    return wrench + self._offset + self._noise * self._rng.normal(size=6)

  def _error(self) -> np.ndarray:
    """Returns an error drawn uniformly from within the accuracy."""
    most = self._most * np.repeat([FORCE_ACCURACY, TORQUE_ACCURACY], 3)
    return most * self._rng.uniform(-1, 1, 6)
