"""One cycle of control: from measurement and action to the next command.

It has no clock, process or device, so tests and simulators drive it at any speed.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import TIMESTEP, Limits, MotionLimiter
from apnpql_jax.robot.protocols import ArmState
from apnpql_jax.robot.supervisor import Action, Mode, Supervisor
from apnpql_jax.robot.virtual_arm import Admittance, VirtualArm

_LIMITED = 0.01
"""Change of velocity above which the limits count as having changed it, rad/s."""

_ARRIVED = 1e-4
"""Distance at which a pose is reached, rad."""

HOME_SPEED = 0.4
"""Joint velocity of motions between episodes, rad/s."""


@dataclasses.dataclass(frozen=True)
class Command:
  """The outcome of a cycle."""

  position: np.ndarray
  """Joint angles for the arm f64[6], rad."""

  mode: Mode
  """Whether the arm follows, holds or stops."""

  reason: str
  """Why the arm does not follow."""

  at_rest: bool
  """Whether the command stands still."""


class Core:
  """The virtual arm behind the supervisor and the limits; one per robot."""

  def __init__(
    self,
    limits: Limits,
    *,
    model: ArmModel | None = None,
    admittance: Admittance | None = None,
  ) -> None:
    """Builds everything; contacts are ignored without ``admittance``."""
    model = ArmModel() if model is None else model
    self.limits, self.virtual = limits, VirtualArm(model, admittance=admittance)
    self.limiter = MotionLimiter(limits, model.tool_position)
    self.supervisor = Supervisor(limits, 0.0)

  def start(
    self, now: float, state: ArmState, target: np.ndarray | None = None
  ) -> None:
    """Begins an episode, or the way to a ``target``, at the measured joint angles.

    The first cycle stops if the arm is outside of its limits, or the way leads out.
    """
    self.supervisor = Supervisor(self.limits, now)
    self.virtual.reset(state.position)
    self.supervisor.stop(self.limiter.start(state.position))
    if target is not None:
      self.supervisor.stop(self.limiter.obstruction(target))

  def step(self, now: float, state: ArmState, action: Action | None) -> Command:
    """Returns the command for the next 2 ms."""
    limiter, measured = self.limiter, self._measured(now, state)
    mode, reason = self.supervisor.judge(now, state, action, limiter.position)
    if mode is Mode.FOLLOW and action is not None:
      self.virtual.step(action.values[:6], measured, state.wrench)
      self._follow_virtual(measured)
    elif mode is Mode.HOLD and self._gives_way(measured, state.wrench):
      self._follow_virtual(measured)
    else:
      limiter.brake(measured)
      self.virtual.synchronize(limiter.position, limiter.velocity)
    return Command(limiter.position.copy(), mode, reason, limiter.at_rest)

  def _gives_way(self, measured: np.ndarray, wrench: np.ndarray) -> bool:
    """Feels the wrench f64[6] in a hold; returns whether it moves the virtual arm.

    It does so only in a hold because of a force, and only while the filtered wrench is
    beyond the dead zone: otherwise only training's weak motors would slow the arm.
    """
    if not (self.supervisor.pressed and self.virtual.admittance):
      return False
    self.virtual.step(np.zeros(6), measured, wrench)
    return self.virtual.share > 0

  def _follow_virtual(self, measured: np.ndarray) -> None:
    """Moves as the virtual arm does, if allowed."""
    limiter, virtual = self.limiter, self.virtual
    # Not the position, whose lead exceeds the limit of acceleration: 1.6 ms later.
    proposed = virtual.velocity
    limiter.step(proposed, measured, yielding=virtual.share > 0)
    limited = np.abs(limiter.velocity - proposed).max() > _LIMITED
    virtual.synchronize(limiter.position, limiter.velocity if limited else proposed)

  def move(self, now: float, state: ArmState, target: np.ndarray) -> Command:
    """Returns the command for the next 2 ms on a straight line of joints to a pose.

    All joints start and slow down together, so neither the acceleration nor the ranges
    of single joints bend the line, and neither does a hold. Only an arm that lags by
    more than ``Limits.deviation`` leaves it; a new line then leads to the pose.
    """
    limiter, gap = self.limiter, target - self.limiter.position
    mode, reason = self.supervisor.judge_arm(now, state, limiter.position)
    far = np.abs(gap).max()
    if mode is Mode.FOLLOW and far > _ARRIVED:
      slowing = 0.5 * self.limits.acceleration
      speed = np.abs(limiter.velocity).max() + slowing * TIMESTEP
      most = min(HOME_SPEED, self.limits.velocity)
      speed = min(speed, most, np.sqrt(2 * slowing * far), far / TIMESTEP)
      limiter.step(gap / far * speed, state.position)
    else:
      limiter.brake(self._measured(now, state))
    return Command(limiter.position.copy(), mode, reason, limiter.at_rest)

  def _measured(self, now: float, state: ArmState) -> np.ndarray:
    """Returns the joint angles; NaN if they are too old to stay close to."""
    fresh = now - state.time <= self.limits.joint_age
    return state.position if fresh else np.full(6, np.nan)

  def has_arrived(self, target: np.ndarray) -> bool:
    """Returns whether ``move`` has reached its target, at rest."""
    limiter = self.limiter
    return limiter.at_rest and np.abs(target - limiter.position).max() <= _ARRIVED
