"""Limits of the motion that hold whatever the policy does.

Every 2 ms a ``MotionLimiter`` turns a proposed joint velocity into the position that
the arm is to have next. Its state always leaves a way to stop inside of the boxes: the
next velocity is accepted only if braking from it ends inside.

An arm may begin on the border, where it may have come to rest, or beyond it by its own
error. From there, or from where something has pushed it, it may only move inward.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

import numpy as np

from apnpql_jax.sim.motors import MAX_ACCELERATION, MAX_VELOCITY

TIMESTEP = 0.002
"""Cycle of the controller, s: 500 Hz, as the arm's."""

BRAKING = 4.0
"""Deceleration after a fault, and largest acceleration in contact, rad/s^2.

Training's 1.2 rad/s^2 would take 0.83 s from 1 rad/s. This takes 0.25 s, which leaves
as much for detection and for the lag of the arm.
"""

DEVIATION = 0.05
"""Largest distance of a commanded joint angle from the measured one, rad."""

MARGIN = 0.002
"""Distance from the workspace box that is kept, m; above the error of its samples."""

SLACK = 0.002
"""How far the tool may begin outside of the workspace box, m.

The error of a measured arm at rest against its command; 2 mm at 0.8 m are 2.5 mrad.
"""

JOINT_SLACK = 0.0025
"""How far a joint may begin outside of its range, rad; see ``SLACK``."""

_STILL = 1e-6
"""Joint velocity below which a command stands still, rad/s."""

_WAY_STEP = 0.004
"""Spacing of the poses at which a path is checked before it begins, rad.

If all joints turn by this much, the tool stays within 0.1 mm of the chord.
"""

_GRACE = 1e-4
"""How much farther out a tool that began outside may go, m, as its path may curve."""

_EVERYWHERE = np.array([[-np.inf, np.inf]] * 3)

_OUT = "outside the workspace box"

_WAY = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Parts of a braking distance at which the tool must be inside the workspace box."""


@dataclasses.dataclass(frozen=True)
class Limits:
  """The limits of a cell; the defaults are those of the training or of the arm."""

  box: np.ndarray
  """Workspace of the tool in the world, f64[3, 2]: lowest and highest x, y, z in m."""

  joints: np.ndarray
  """Lowest and highest joint angles f64[6, 2], rad."""

  velocity: float = MAX_VELOCITY
  """Joint velocity, rad/s."""

  acceleration: float = MAX_ACCELERATION
  """Joint acceleration in free motion, rad/s^2."""

  braking: float = BRAKING
  """Joint deceleration after a fault, rad/s^2."""

  deviation: float = DEVIATION
  """Distance of a commanded joint angle from the measured one, rad."""

  hold_force: float = 30.0
  """Force on the tool at which the arm holds, N."""

  stop_force: float = 50.0
  """Force on the tool at which the arm stops, N."""

  frame_age: float = 0.1
  """Age of a frame, when its action is chosen, from which the arm holds, s."""

  joint_age: float = 0.02
  """Age of the measured joints from which the arm stops, s."""

  gripper_age: float = 0.3
  """Age of the gripper's measurement from which the arm stops, s.

  Its line is slow: a message takes up to 22 ms, and the settings that go with the first
  command are about ten. A driver that notices silence itself stops the arm earlier.
  """

  period: float = 0.15
  """Control period of the policy, s. One period late the arm holds, two it stops."""


class MotionLimiter:
  """A commanded state that moves within the limits."""

  def __init__(
    self, limits: Limits, tool_position: Callable[[np.ndarray], np.ndarray]
  ) -> None:
    """Keeps the limits; ``tool_position`` maps joint angles to m in the world."""
    self.limits, self._tool = limits, tool_position
    self.position, self.velocity = np.zeros(6), np.zeros(6)
    self._inside = limits.box + np.array([MARGIN, -MARGIN])
    self._box = self._inside
    """Where the tool may be: inside, or no farther out than it has begun, f64[3, 2]."""

  def start(self, position: np.ndarray) -> str:
    """Begins at rest; returns why the arm must not move there, or an empty string."""
    self.position, self.velocity = np.array(position, float), np.zeros(6)
    if reason := self.outside(self.position, is_there=True):
      return reason
    self._box = self._tightened(_EVERYWHERE, self._tool(self.position))
    return ""

  def outside(self, position: np.ndarray, *, is_there: bool = False) -> str:
    """Returns why a pose is outside of the limits, or an empty string.

    Args:
      position: Joint angles f64[6].
      is_there: The arm is at the pose, so its own error is allowed.
    """
    slack = np.array([-1.0, 1.0]) * is_there
    low, high = (self.limits.joints + JOINT_SLACK * slack).T
    joints = np.flatnonzero(~((low <= position) & (position <= high)))
    if len(joints):
      return f"joint {', '.join(map(str, joints + 1))} is outside its range"
    tool = self._tool(position)
    box = self.limits.box + SLACK * slack if is_there else self._inside
    return "" if _holds(box, tool) else f"the tool at {_text(tool)} is {_OUT}"

  def obstruction(self, target: np.ndarray) -> str:
    """Returns why the straight way of joints to a pose f64[6] is not free."""
    if reason := self.outside(target):
      return f"at the end of the way {reason}"
    way, box = target - self.position, self._box
    count = 2 + int(np.abs(way).max() / _WAY_STEP)
    for part in np.linspace(0.0, 1.0, count):
      tool = self._tool(self.position + part * way)
      if not _holds(box, tool):
        return (
          f"on the straight way the tool at {_text(tool)} is {_OUT}: first move the "
          "arm by hand to where its way is free"
        )
      box = self._tightened(box, tool)
    return ""

  def step(
    self, velocity: np.ndarray, measured: np.ndarray, *, yielding: bool = False
  ) -> np.ndarray:
    """Returns the next commanded joint angles f64[6].

    Args:
      velocity: Proposed joint velocities f64[6], rad/s; brakes if not finite.
      measured: Joint angles of the arm f64[6], which the command stays close to. This
        may take more than the acceleration limit, but never more than the velocity.
        NaN if they are not known.
      yielding: The motion gives way to a contact, with up to ``braking``.
    """
    if not np.isfinite(velocity).all():
      return self.brake(measured)
    limits = self.limits
    most = TIMESTEP * (limits.braking if yielding else limits.acceleration)
    chosen = velocity.clip(-limits.velocity, limits.velocity)
    chosen = chosen.clip(self.velocity - most, self.velocity + most)
    chosen = self._within_joints(chosen)
    if not self._can_stop(chosen):
      chosen = self._within_joints(self._slower(limits.acceleration))
    return self._advance(self._near(chosen, measured))

  def brake(self, measured: np.ndarray) -> np.ndarray:
    """Returns the next commanded joint angles f64[6], on the way to rest.

    The command does not follow an arm that moves away: no joint gets faster.
    """
    slower = self._within_joints(self._slower(self.limits.braking))
    near = self._near(slower, measured)
    return self._advance(near.clip(np.minimum(slower, 0.0), np.maximum(slower, 0.0)))

  def halt(self) -> None:
    """Leaves the command where it is, for an arm that is at rest there."""
    self.velocity = np.zeros(6)

  @property
  def at_rest(self) -> bool:
    """Whether the command stands still."""
    return bool(np.abs(self.velocity).max() < _STILL)

  def _slower(self, deceleration: float) -> np.ndarray:
    """Returns the velocity after a cycle of braking on a straight line of joints."""
    fastest = np.abs(self.velocity).max()
    return self.velocity * max(0.0, 1 - deceleration * TIMESTEP / max(fastest, 1e-9))

  def _within_joints(self, velocity: np.ndarray) -> np.ndarray:
    """Returns a velocity from which each joint can stop inside its range."""
    low, high = self.limits.joints.T
    slowing = self.limits.acceleration
    step = slowing * TIMESTEP
    # The solution v of h v + v^2 / (2 a) = room, so that a further cycle exists.
    up, down = (
      np.sqrt(step**2 + 2 * slowing * room.clip(0.0)) - step
      for room in (high - self.position, self.position - low)
    )
    return velocity.clip(-down, up)

  def _can_stop(self, velocity: np.ndarray) -> bool:
    """Returns whether braking after a cycle with ``velocity`` stays in the box."""
    after = self.position + TIMESTEP * velocity
    way = velocity * np.abs(velocity).max() / (2 * self.limits.acceleration)
    for part in _WAY:
      if not _holds(self._box, self._tool(after + part * way)):
        return False
    return True

  def _near(self, velocity: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Returns a velocity that keeps the command close to the measured angles."""
    if not np.isfinite(measured).all():
      return velocity
    gap, most = measured - self.position, self.limits.deviation
    velocity = velocity.clip((gap - most) / TIMESTEP, (gap + most) / TIMESTEP)
    return velocity.clip(-self.limits.velocity, self.limits.velocity)

  def _advance(self, velocity: np.ndarray) -> np.ndarray:
    self.position = self.position + TIMESTEP * velocity
    self.velocity = velocity
    tool = self._tool(self.position)
    # Out of the box, the arm itself has taken the command along.
    box = self._box if _holds(self._box, tool) else _EVERYWHERE
    self._box = self._tightened(box, tool)
    return self.position.copy()

  def _tightened(self, box: np.ndarray, tool: np.ndarray) -> np.ndarray:
    """Returns the box f64[3, 2] without the part farther out than the tool is."""
    if _holds(self._inside, tool):
      return self._inside
    low = np.minimum(self._inside[:, 0], tool - _GRACE)
    high = np.maximum(self._inside[:, 1], tool + _GRACE)
    return np.stack([np.maximum(box[:, 0], low), np.minimum(box[:, 1], high)], axis=1)


def _holds(box: np.ndarray, tool: np.ndarray) -> bool:
  """Returns whether a point f64[3] is in a box f64[3, 2]."""
  return bool(((box[:, 0] <= tool) & (tool <= box[:, 1])).all())


def _text(tool: np.ndarray) -> str:
  return f"({', '.join(f'{x:.3f}' for x in tool)}) m"
