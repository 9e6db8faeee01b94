"""How stiff a contact may be before the virtual arm oscillates, by linear analysis.

The loop: the virtual tool moves, and the real one follows after ``lag``. The contact
pushes the real tool back with k times its displacement, and the filtered force acts on
the virtual arm. With one force along a direction n this is a loop of one signal, with
the transfer function

  a k e^(-s lag) / (1 + s T) n^T J (M s^2 + (25 M + a J^T D_c J) s)^-1 J^T n

It is stable while its value is above -1 where its phase is -180 degrees (Nyquist). The
share a (``virtual_arm.ramp``) is that of the wrench at which the arm rests, because it
is the slope of the felt force as well as the share of the damping.
"""

from __future__ import annotations

import numpy as np

from apnpql_jax.robot.arm_model import Dynamics
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.virtual_arm import DAMPED_RADIUS, FILTER_HZ, Admittance
from apnpql_jax.sim.motors import VELOCITY_GAIN

FILTER_S = 1 / (2 * np.pi * FILTER_HZ)
"""Time constant T of the wrench's filter, s."""

_FREQUENCIES = np.geomspace(0.1, np.pi / TIMESTEP, 4000)  # rad/s


def stiffness_limit(
  dynamics: Dynamics,
  direction: np.ndarray,
  admittance: Admittance,
  lag: float,
  *,
  share: float = 1.0,
  saturated: bool = False,
) -> float:
  """Returns the largest stable stiffness of a contact at the tool, N/m.

  Args:
    dynamics: Those of the arm at a pose.
    direction: Unit vector of the contact's force in the world, f64[3].
    admittance: Gives D_c.
    lag: Delay between the virtual position and the measured force, without that of the
      filter, s.
    share: The share a.
    saturated: The motors are at their limit of acceleration, and do not damp.
  """
  rows = share * admittance.damping * np.repeat([1.0, DAMPED_RADIUS**2], 3)
  damping = dynamics.tool.T @ (rows[:, None] * dynamics.tool)
  if not saturated:
    damping = damping + VELOCITY_GAIN * dynamics.mass
  way = dynamics.tool[:3].T @ direction
  s = 1j * _FREQUENCIES[:, None, None]
  moved = np.linalg.solve(dynamics.mass * s**2 + damping * s, way[:, None])
  s = s[:, 0, 0]
  loop = np.exp(-s * lag) / (1 + s * FILTER_S) * share * (moved[..., 0] @ way)
  # The phase begins at -90 degrees and falls; each crossing of -180 limits the gain.
  turns = np.flatnonzero((loop.imag[:-1] < 0) & (loop.imag[1:] >= 0))
  crossing = [-loop.real[i] for i in turns if loop.real[i] < 0]
  return float(1 / max(crossing)) if crossing else np.inf
