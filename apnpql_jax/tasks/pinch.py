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

NEAR = 0.012
"""m; the hand may close when its pinch point is this close to where it shall grip. What
stands freely is centered by the closing pads, and a policy that sees a pixel per
centimeter hardly comes closer."""

LOST = 0.025
"""m; what is further from the pinch point is not in the hand."""

STRAIGHT = 0.25
"""rad; the hand may close when it is turned away by less: the pads turn what stands
freely."""

ALIGNED, FUNNEL = 0.012, 0.05
"""m; the tool goes in fully within the first, stays out beyond the second."""

LEVER = 0.05
"""m/rad; how much a twist of the fingers beyond half of what is allowed counts as being
off."""


class Pinch:
  """A grip between the pads on something of known width, by a vertical tool.

  All methods are batched over worlds.
  """

  def __init__(
    self,
    scene: Scene,
    neutral_mat: Array,
    *,
    width: float,
    above: float,
    hover: float,
    travel: float,
    near: float = NEAR,
    straight: float = STRAIGHT,
  ):
    """
    Args:
      scene: gives the tool site and the finger.
      neutral_mat: f32[3, 3], the tool's rotation at heading zero.
      width: m, of what is gripped.
      above: m, distance along the tool from where it is aimed at to the pads' center.
      hover: m, height over the grasp at which the open finger tips clear the object.
      travel: m, tool height at which closed fingers clear everything.
      near: m, see ``NEAR``.
      straight: rad, see ``STRAIGHT``.
    """
    self._hover, self._travel = hover, travel
    self._near, self._straight = near, straight
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

  def approach(
    self, state: PhysicsState, kinematics: Kinematics, aim: Array, twist: Array
  ) -> Array:
    """Tool position that leads around ``aim`` without knocking it over.

    A low tool rises first; over the object it descends through a funnel, but not with
    fingers that are closed on nothing; around the object it stays.

    Args:
      state: [worlds, ...].
      kinematics: [worlds, ...].
      aim: f32[worlds, 3], m.
      twist: f32[worlds], rad.

    Returns:
      f32[worlds, 3], m.
    """
    tool = kinematics.site_xpos[:, self._scene.tool_site]
    off = geometry.norm(tool[:, :2] - aim[:, :2]) + off_by(twist, self._straight)
    height = geometry.funnel(off, aligned=ALIGNED, wide=FUNNEL)
    at_it = self.holds(state, kinematics, aim) | self.around(kinematics, aim, twist)
    height = self._hover * jnp.where(at_it | self.is_open(state), height, 1.0)
    down = geometry.up(aim[:, :2], aim[:, 2] - self.depth + height)
    return self._rise_first(tool, aim, down)

  def above(self, kinematics: Kinematics, place: Array) -> Array:
    """Tool position f32[worlds, 3] (m) high over a place; a low tool rises first."""
    tool = kinematics.site_xpos[:, self._scene.tool_site]
    return self._rise_first(tool, place, geometry.up(place[:, :2], self._travel))

  def _rise_first(self, tool: Array, place: Array, target: Array) -> Array:
    low = tool[:, 2] < self._travel - 0.02
    away = geometry.norm(tool[:, :2] - place[:, :2]) > FUNNEL
    rise = geometry.up(tool[:, :2], self._travel)
    return jnp.where((low & away)[:, None], rise, target)

  def around(self, kinematics: Kinematics, point: Array, twist: Array) -> Array:
    """bool[worlds]: where the hand may close to grip ``point`` (m)."""
    near = geometry.norm(self.point(kinematics) - point) < self._near
    return near & (jnp.abs(twist) < self._straight)


def off_by(twist: Array, straight: float = STRAIGHT) -> Array:
  """How far off (m) a hand counts that is turned away by ``twist`` (rad)."""
  return LEVER * jnp.maximum(jnp.abs(twist) - straight / 2, 0.0)


def grip(*, around: Array, held: Array, done: Array) -> Array:
  """Gripper commands f32[worlds, 3] of the primitives of such tasks.

  The hand closes around the object, stays closed until the object is where it shall
  be let go, and opens there; neutral is an open hand.

  Args:
    around: bool[worlds], the hand may close.
    held: bool[worlds], the object is in the hand.
    done: bool[worlds], the object is where it shall be let go.
  """
  close = (held | around) & ~done
  return jnp.stack([close, close, jnp.zeros_like(close)], 1).astype(jnp.float32)


def pick_and_place(
  primitives: Array,
  *,
  held: Array,
  done: Array,
  is_open: Array,
  withdraw: int = 2,
) -> Array:
  """Reach, close, carry, open, withdraw: the scripted expert of such tasks.

  Args:
    primitives: f32[worlds, 3, 7]; object, goal, neutral.
    held: bool[worlds], the object is in the hand.
    done: bool[worlds], the object is where it shall be let go.
    is_open: bool[worlds], the hand has let go.
    withdraw: which primitive leads the open hand away.

  Returns:
    f32[worlds, 7].
  """
  # While the fingers open, stay with the object.
  choice = jnp.where(done, jnp.where(is_open, withdraw, 0), jnp.where(held, 1, 0))
  return jnp.take_along_axis(primitives, choice[:, None, None], axis=1)[:, 0]


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
  """How far (m) the pads' center lies behind the tool site at this gap.

  The pads travel forward on an arc as the fingers close; the site is where their
  tips end when closed. Closed form of the maker's linkage.
  """
  angle = finger_angle(gap) + FINGER_ANGLE
  return 0.1449 - (0.078 + FINGER_LENGTH * jnp.sin(angle))
