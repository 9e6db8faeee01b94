"""The motors of arm and gripper, as in training and in the runtime of the real arm.

The arm follows desired joint velocities by inverse dynamics (paper Sec. V-C): a desired
acceleration from the velocity error, limited, turned into joint torques by the mass
matrix and the bias torque. The module does not import JAX.
"""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_VELOCITY = 1.0  # rad/s; the paper's "m/s" can only mean joint space
MAX_ACCELERATION = 1.2  # rad/s^2 (paper Sec. V-A)
VELOCITY_GAIN = 25.0  # 1/s; reaches the desired velocity well within a 0.15 s period
GRIPPER_SPEED = 0.075  # m/s of pad gap: the closing speed in the manufacturer's manual
GRIPPER_GAIN = 10.0  # N m s/rad, half of what is stable for the fingers at 5 ms steps
GRIPPER_TORQUE = 3.5  # N m, as in the manufacturer's model: 30-60 N per pad
FINGER_LENGTH = 0.057  # m, L in gap(q) = 2 (4.1 mm + L cos(q + FINGER_ANGLE))
FINGER_ANGLE = np.pi / 6


def arm_torque(mass: Any, bias: Any, qvel: Any, desired: Any, limit: Any) -> Any:
  """Computes the inverse-dynamics torque [*b, 6] of the arm; NumPy or JAX arrays.

  tau = M clip(gain (v* - v), +-a_max) + bias, clipped to the joint's limit. M is the
  arm's block of the mass matrix, kg m^2; bias is the Coriolis, centrifugal and gravity
  torque. Velocities are in rad/s, torques in N m.
  """
  desired = desired.clip(-MAX_VELOCITY, MAX_VELOCITY)
  acceleration = VELOCITY_GAIN * (desired - qvel)
  acceleration = acceleration.clip(-MAX_ACCELERATION, MAX_ACCELERATION)
  return ((mass * acceleration[..., None, :]).sum(-1) + bias).clip(-limit, limit)


def gripper_torque(
  angle: Any, velocity: Any, close: Any, xp: Any, *, speed: Any = GRIPPER_SPEED
) -> Any:
  """Computes the torque of the driven finger: constant pad speed, limited squeeze.

  C MuJoCo and MJX integrate the saturated force of a MuJoCo velocity actuator
  differently, so this is an explicit servo: from the finger's angle (rad, 0 = open) and
  velocity (rad/s) to N m, positive closes. A ``close`` of 1 closes, 0 opens; other
  values are clipped to [0, 1]. ``speed`` is that of the pad gap, m/s.
  """
  desired = finger_rate(angle, close, xp, speed=speed)
  return (GRIPPER_GAIN * (desired - velocity)).clip(-GRIPPER_TORQUE, GRIPPER_TORQUE)


def finger_rate(angle: Any, close: Any, xp: Any, *, speed: Any = GRIPPER_SPEED) -> Any:
  """Computes the speed (rad/s) of the driven finger that moves the pads at ``speed``.

  The arguments are those of ``gripper_torque``.
  """
  slope = 2 * FINGER_LENGTH * xp.sin(angle.clip(0.0, 1.1) + FINGER_ANGLE)
  return (2 * xp.clip(close, 0.0, 1.0) - 1) * speed / slope
