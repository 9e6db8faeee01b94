"""The virtual arm: training's motor model and admittance, whose position the arm gets.

A position-controlled arm does not move as the simulated one does, whose motors are
torques. So the arm is simulated in step with the real one, and the real one follows its
position ("simulation in the loop"). The wrench of the real tool acts on the simulated
arm, which makes this admittance control (Keemink et al. 2018, IJRR 37(11)):

  M q'' = M clip(25 (v* - q'), +-1.2) + J^T f - s J_t^T D_c J_t q'

M is the mass matrix, v* the policy's joint velocity, J the Jacobian of the flange and
J_t that of the tool. F is the measured wrench after a low-pass filter of 20 Hz, and r
its size in terms of what a free hand may read (``sensor.load``: 7.5 N and 0.6 N m).

  s = clip(r - 1, 0, 1)                    share of the damping
  f = F / r * (integral of s from 1 to r)  felt wrench

Up to r = 1, the sensor's error could be all of the wrench, and nothing is felt. Without
that dead zone, the arm would drift: at rest, a few newtons move it. Beyond it, damping
and the slope of f set in together, and are complete at r = 2. So no error within the
accuracy slows a free arm; one of 8 N takes more than half of its speed. The arm answers
hits and jams, but not the force of a plate that it pushes. Its main use is that it
moves as in training.

Stability: let k be the stiffness of what the tool touches, and tau the lag: the sum of
all delays and time constants between the virtual position and F. A mode with damping B
begins to oscillate with frequency w where B = k sin(w tau) / w, which is at most k tau.
So every B > k tau is stable, for each mass. B is 25 m + D_c with the mass m that the
tool feels along the contact; at the motors' limit of acceleration it is D_c alone. So
D_c = 1.5 k tau is stable for walls of up to 1.5 k, whatever the policy commands. Where
the arm rests with s < 1, it feels the stiffness s k and has the damping s D_c, so the
same walls are stable there. If the slope set in before the damping, the contact would
buzz at the edge of the dead zone. The damping is integrated implicitly, because it may
exceed m / TIMESTEP.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import BRAKING, DEVIATION, TIMESTEP
from apnpql_jax.robot.sensor import load
from apnpql_jax.sim import motors

CYCLE_MS = round(1e3 * TIMESTEP)
TRAINING_STEP_MS = 5
"""Training computes torques every 5 ms; so does the virtual arm, to move equally."""

LEAD = 0.0016
"""By how much training's position is ahead of the integral of a ramp, s.

In a step of 5 ms from v with acceleration a, training moves by 5 v + 25 a, and parts of
2, 2 and 1 ms move by 5 v + 17 a.
"""

FILTER_HZ = 20.0
"""Corner frequency of the wrench's low-pass filter, Hz."""

DAMPED_RADIUS = 0.1
"""Distance from the tool at which D_c damps a rotation as much as a translation, m."""


@dataclasses.dataclass(frozen=True)
class Admittance:
  """Parameters of the virtual arm's answer to contacts."""

  stiffness: float = 10_000.0
  """Stiffness k of the hardest contact to expect, N/m."""

  lag: float = 0.045
  """tau, s: 35 ms of the arm, 8 ms of the filter, 2 ms of the cycle."""

  @property
  def damping(self) -> float:
    """D_c, N s/m."""
    return 1.5 * self.stiffness * self.lag


class VirtualArm:
  """A simulated arm that is advanced by 2 ms at a time.

  arm = VirtualArm()
  arm.reset(measured_position)
  while True:
    arm.step(action[:6], measured_position, wrench)
    real.send_action(arm.position)
  """

  def __init__(
    self, model: ArmModel | None = None, *, admittance: Admittance | None = None
  ) -> None:
    """Builds the arm; it ignores the wrench without ``admittance``."""
    self.model = ArmModel() if model is None else model
    self.admittance = admittance
    self.position, self.velocity = np.zeros(6), np.zeros(6)
    """Joint angles f64[6] in rad, and velocities in rad/s."""
    self.share = 0.0
    """Share s of the damping: above 0 the filtered wrench is beyond the dead zone."""
    self._wrench, self._desired, self._motors = np.zeros(6), np.zeros(6), np.zeros(6)
    self._held_ms = 0
    self._smoothing = 1 - np.exp(-2 * np.pi * FILTER_HZ * TIMESTEP)

  def reset(self, position: np.ndarray) -> None:
    """Starts again at rest at the measured joint angles f64[6], as after each pause."""
    self.synchronize(position, np.zeros(6))
    self._wrench, self.share, self._held_ms = np.zeros(6), 0.0, 0

  def synchronize(self, position: np.ndarray, velocity: np.ndarray) -> None:
    """Takes over joint angles and velocities f64[6] that the limits have changed."""
    self.position, self.velocity = np.array(position, float), np.array(velocity, float)

  def step(
    self,
    desired: np.ndarray,
    measured: np.ndarray | None = None,
    wrench: np.ndarray | None = None,
  ) -> np.ndarray:
    """Advances by 2 ms and returns the joint angles f64[6], rad.

    Args:
      desired: Desired joint velocities f64[6] of the policy, rad/s.
      measured: Joint angles of the real arm f64[6]; the virtual ones stay within
        ``limits.DEVIATION`` of them.
      wrench: Force and torque on the tool f64[6] as in ``protocols.ArmState``.
    """
    desired, force = np.asarray(desired, float), self._felt(wrench)
    if (desired != self._desired).any():  # As in training, it counts at once.
      self._desired, self._held_ms = desired.copy(), 0
    left_ms = CYCLE_MS
    while left_ms:
      if not self._held_ms:
        self._motors, self._held_ms = self._motor_acceleration(), TRAINING_STEP_MS
      part_ms = min(left_ms, self._held_ms)
      self._integrate(1e-3 * part_ms, force)
      left_ms, self._held_ms = left_ms - part_ms, self._held_ms - part_ms
    if measured is not None:
      self.position = self.position.clip(measured - DEVIATION, measured + DEVIATION)
    return self.position.copy()

  def _motor_acceleration(self) -> np.ndarray:
    """Returns the joint acceleration f64[6] that training's motors cause, rad/s^2."""
    dynamics = self.model.dynamics(self.position, self.velocity)
    torque = motors.arm_torque(
      dynamics.mass,
      dynamics.bias,
      self.velocity,
      self._desired,
      self.model.torque_limit,
    )
    return np.linalg.solve(dynamics.mass, torque - dynamics.bias)

  def _integrate(self, seconds: float, force: np.ndarray) -> None:
    """Advances by semi-implicit Euler, as MuJoCo does."""
    acceleration = self._motors
    if self.share:
      dynamics = self.model.dynamics(self.position, self.velocity)
      # Implicit Euler: (M + h D) (v' - v) = h (M a + J^T F - D v).
      damping = np.repeat(self._damping, 3)
      damper = dynamics.tool.T @ (damping[:, None] * dynamics.tool)
      push = dynamics.mass @ self._motors + dynamics.flange.T @ force
      push -= damper @ self.velocity
      acceleration = np.linalg.solve(dynamics.mass + seconds * damper, push)
      acceleration = acceleration.clip(-BRAKING, BRAKING)
    velocity = self.velocity + seconds * acceleration
    self.velocity = velocity.clip(-motors.MAX_VELOCITY, motors.MAX_VELOCITY)
    self.position = self.position + seconds * (self.velocity + LEAD * acceleration)

  @property
  def _damping(self) -> np.ndarray:
    """Damping s D_c of translations (N s/m) and of rotations (N m s)."""
    assert self.admittance is not None
    return self.share * self.admittance.damping * np.array([1.0, DAMPED_RADIUS**2])

  def _felt(self, wrench: np.ndarray | None) -> np.ndarray:
    """Returns the felt wrench f in the world, f64[6], and sets the share s."""
    if self.admittance is None or wrench is None:
      return np.zeros(6)
    # A reading that is not finite is a fault of the sensor, not a contact.
    given = np.nan_to_num(np.asarray(wrench, float), posinf=0.0, neginf=0.0)
    self._wrench += self._smoothing * (given - self._wrench)
    relative = load(self._wrench)
    self.share, felt = ramp(relative)
    return (self._wrench.reshape(2, 3) @ self.model.base_mat.T).ravel() * felt


def ramp(relative: float) -> tuple[float, float]:
  """Returns the share s at a wrench of ``relative`` size r, and f / F."""
  share = min(max(relative - 1, 0.0), 1.0)
  integral = share**2 / 2 + max(relative - 2, 0.0)
  return share, integral / max(relative, 1.0)
