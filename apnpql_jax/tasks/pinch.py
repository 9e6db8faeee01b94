"""The hand as tasks see it: where it pinches, what it holds, how to pick and place."""

from __future__ import annotations

import jax.numpy as jnp

from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import FINGER_ANGLE, FINGER_LENGTH, PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import geometry
from apnpql_jax.types import Array

TOLERANCE = 0.004
"""m; how far the pads' gap may be from an object's width while they hold it."""

CLEARANCE = 0.02
"""m; an open hand leaves this much, both sides together."""

NEAR = 0.01
"""m; the hand may close when its pinch point is this close to where it shall grip."""

LOST = 0.025
"""m; what is further from the pinch point is not in the hand."""

STRAIGHT = 0.1
"""rad; the hand may close when it is turned away by less."""


class Pinch:
  """A grip between the pads on something of known width, by a vertical tool.

  All methods are batched over worlds.
  """

  def __init__(self, scene: Scene, neutral_mat: Array, *, width: float, above: float):
    """
    Args:
      scene: gives the tool site and the finger.
      neutral_mat: f32[3, 3], the tool's rotation at heading zero.
      width: m, of what is gripped.
      above: m, distance along the tool from where it is aimed at to the pads' centre.
    """
    self._scene, self._neutral_mat, self._width = scene, neutral_mat, width
    self.depth = float(pinch_height(width)) - above
    """m from the tool site back to the point that is aimed at what is gripped."""

  def point(self, kinematics: Kinematics) -> Array:
    """f32[worlds, 3]: where the gripped point of an object in the hand is, m."""
    mat = kinematics.site_xmat[:, self._scene.tool_site]
    tool = kinematics.site_xpos[:, self._scene.tool_site]
    return tool - self.depth * mat[:, :, 2]

  def twist(self, kinematics: Kinematics, heading: Array, period: float) -> Array:
    """f32[worlds]: how far the hand is turned away from a heading, rad."""
    mat = kinematics.site_xmat[:, self._scene.tool_site] @ self._neutral_mat.T
    return geometry.fold(jnp.arctan2(mat[:, 1, 0], mat[:, 0, 0]) - heading, period)

  def is_open(self, state: PhysicsState) -> Array:
    """bool[worlds]: the pads are clear of the object on both sides."""
    return is_open(self._scene, state, self._width)

  def holds(self, state: PhysicsState, kinematics: Kinematics, point: Array) -> Array:
    """bool[worlds]: the pads grip something of this width, at ``point`` (m)."""
    gripping = is_gripping(self._scene, state, self._width)
    return gripping & (geometry.norm(self.point(kinematics) - point) < LOST)

  def around(self, kinematics: Kinematics, point: Array, twist: Array) -> Array:
    """bool[worlds]: where the hand may close to grip ``point`` (m)."""
    near = geometry.norm(self.point(kinematics) - point) < NEAR
    return near & (jnp.abs(twist) < STRAIGHT)


def pick_and_place(
  primitives: Array,
  *,
  around: Array,
  held: Array,
  done: Array,
  is_open: Array,
  withdraw: int = 2,
) -> Array:
  """Reach, close, carry, open, withdraw: the scripted expert of such tasks.

  Args:
    primitives: f32[worlds, 3, 6], rad/s; object, goal, neutral.
    around: bool[worlds], the hand may close.
    held: bool[worlds], the object is in the hand.
    done: bool[worlds], the object is where it shall be let go.
    is_open: bool[worlds], the hand has let go.
    withdraw: which primitive leads the open hand away.

  Returns:
    f32[worlds, 7].
  """
  # While the fingers open, stay with the object.
  choice = jnp.where(done, jnp.where(is_open, withdraw, 0), jnp.where(held, 1, 0))
  velocity = jnp.take_along_axis(primitives, choice[:, None, None], axis=1)[:, 0]
  close = (held | around) & ~done
  return jnp.concatenate([velocity, close[:, None].astype(velocity.dtype)], -1)


def is_open(scene: Scene, state: PhysicsState, width: Array | float) -> Array:
  """bool[worlds]: the pads are clear of something ``width`` (m) wide, on both sides."""
  return state.qpos[:, scene.gripper_qpos] < finger_angle(width + CLEARANCE)


def is_gripping(scene: Scene, state: PhysicsState, width: Array | float) -> Array:
  """bool[worlds]: the fingers have closed to ``width`` (m) and no further."""
  angle = state.qpos[:, scene.gripper_qpos]
  low, high = finger_angle(width + TOLERANCE), finger_angle(width - TOLERANCE)
  return (angle > low) & (angle < high)


def finger_angle(gap: Array | float) -> Array:
  """Angle of the driven finger (rad) at which the pads are ``gap`` (m) apart."""
  return jnp.arccos((gap / 2 - 0.0041) / FINGER_LENGTH) - FINGER_ANGLE


def pinch_height(gap: Array | float) -> Array:
  """How far (m) the pads' centre lies behind the tool site at this gap.

  The pads travel forward on an arc as the fingers close; the site is where their
  tips end when closed. Closed form of the maker's linkage.
  """
  angle = finger_angle(gap) + FINGER_ANGLE
  return 0.1449 - (0.078 + FINGER_LENGTH * jnp.sin(angle))
