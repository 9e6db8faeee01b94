"""The judge of each control cycle: follow the policy, hold, or stop, and why.

Both a hold and a stop brake to rest, but in a hold because of the force on the tool, an
arm with admittance gives way to it. A hold ends with its cause; a stop ends the
episode.
"""

from __future__ import annotations

import dataclasses
import enum

import numpy as np

from apnpql_jax.robot.limits import Limits
from apnpql_jax.robot.protocols import CAMERAS, ArmState, GripperState

NO_ACTION = "policy: no action yet"
"""Reason of the hold with which each episode begins."""

PATIENCE_S = 5.0
"""Time that the first action may take."""

RELIEF_S = 0.2
"""Time for which the force must be small again before a hold ends."""

JAM_S = 1.0
"""How long a hold because of a force may last before it becomes a stop."""

RUNAWAY = 1.2
"""Multiple of ``Limits.deviation``; an arm farther from its command is stopped."""


class Mode(enum.IntEnum):
  """Behavior of the arm in a cycle."""

  FOLLOW = 0
  HOLD = 1
  STOP = 2


@dataclasses.dataclass(frozen=True)
class Action:
  """An action of the policy, as the control process gets it."""

  number: int
  """Number of the action in its episode, from 1."""

  time: float
  """When it was chosen."""

  values: np.ndarray
  """Desired joint velocities in rad/s, then 1 to close the gripper; f64[7]."""

  frames: np.ndarray
  """When the frames that it was chosen from were captured, f64[2]: see ``CAMERAS``."""


class Supervisor:
  """Supervisor of the measurements and actions of one episode."""

  def __init__(self, limits: Limits, now: float):
    """Begins an episode at the time ``now``."""
    self._limits, self._began = limits, now
    self._number, self._valid, self._refusal = 0, None, ""
    self._forced, self._strong = None, -np.inf
    self._stop = ""

  @property
  def pressed(self) -> bool:
    """Whether the force on the tool is, or just was, so large that the arm holds."""
    return self._forced is not None

  def stop(self, reason: str) -> None:
    """Ends the motion; the first reason stays."""
    self._stop = self._stop or reason

  def judge(
    self, now: float, state: ArmState, action: Action | None, command: np.ndarray
  ) -> tuple[Mode, str]:
    """Returns what to do in this cycle, and the reason unless it is to follow.

    Args:
      now: The present time.
      state: The newest measurement of the arm.
      action: The newest action, if any.
      command: The joint angles that the arm was sent last, f64[6].
    """
    mode, reason = self.judge_arm(now, state, command)
    if mode is Mode.STOP:
      return mode, reason
    late = self._check_actions(now, action)
    if self._stop:
      return Mode.STOP, self._stop
    if mode is Mode.FOLLOW and late:
      return Mode.HOLD, late
    return mode, reason

  def check_gripper(self, now: float, gripper: GripperState) -> None:
    """Ends the motion if the gripper has fallen silent."""
    age = now - gripper.time
    if not age <= self._limits.gripper_age:
      self.stop(f"gripper: measurement is {1e3 * age:.0f} ms old")

  def judge_arm(
    self, now: float, state: ArmState, command: np.ndarray
  ) -> tuple[Mode, str]:
    """Returns what to do without a policy; see ``judge``."""
    self.stop(self._reason_to_stop(now, state, command))
    hold = "" if self._stop else self._check_force(now, state)
    if self._stop:
      return Mode.STOP, self._stop
    return (Mode.HOLD, hold) if hold else (Mode.FOLLOW, "")

  def _reason_to_stop(self, now: float, state: ArmState, command: np.ndarray) -> str:
    limits, age = self._limits, now - state.time
    if state.fault:
      return f"arm: {state.fault}"
    if not age <= limits.joint_age:
      return f"joints: measurement is {1e3 * age:.0f} ms old"
    if not all(np.isfinite(x).all() for x in (state.position, state.wrench)):
      return "arm: a measurement is not finite"
    force = np.linalg.norm(state.wrench[:3])
    if force > limits.stop_force:
      return f"force: {force:.0f} N on the tool"
    away = np.abs(state.position - command).max()
    if away > RUNAWAY * limits.deviation:
      return f"arm: {away:.3f} rad from its command"
    return ""

  def _check_force(self, now: float, state: ArmState) -> str:
    """Returns why to hold because of the force."""
    force = np.linalg.norm(state.wrench[:3])
    if force > self._limits.hold_force:
      self._forced, self._strong = self._forced or now, now
    elif now - self._strong > RELIEF_S:
      self._forced = None
    if self._forced is None:
      return ""
    if now - self._forced > JAM_S:
      self.stop(f"force: {force:.0f} N on the tool for {JAM_S:.0f} s")
    return f"force: above {self._limits.hold_force:.0f} N on the tool"

  def _check_actions(self, now: float, action: Action | None) -> str:
    """Returns why to hold because of the policy."""
    if action is not None and action.number != self._number:
      self._number, self._refusal = action.number, self._refused(action)
      if not self._refusal:
        self._valid = action.time
    waited = now - (self._began if self._valid is None else self._valid)
    period, cause = self._limits.period, self._refusal
    if self._valid is None:
      if waited > PATIENCE_S:
        self.stop(cause or f"policy: no action within {PATIENCE_S:.0f} s")
      return cause or NO_ACTION
    if waited > 3 * period:
      self.stop(cause or "policy: two periods late")
    if waited > 2 * period:
      return cause or "policy: a period late"
    return cause

  def _refused(self, action: Action) -> str:
    """Returns why an action must not be followed."""
    if not np.isfinite(action.values).all():
      return "policy: the action is not finite"
    ages = action.time - action.frames
    if not (ages <= self._limits.frame_age).all():
      oldest = int(np.argmax(np.nan_to_num(ages, nan=np.inf)))
      return f"camera {CAMERAS[oldest]}: frame is {1e3 * ages[oldest]:.0f} ms old"
    return ""
