"""The hand as tasks see it: where it pinches, what it holds, how to pick and place."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Bool, Float

from apnpql_jax.errors import ConfigError
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.motors import FINGER_ANGLE, FINGER_LENGTH
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import geometry
from apnpql_jax.types import Array

Mask = Bool[Array, " worlds"]
Angle = Float[Array, " worlds"]
Point = Float[Array, "worlds 3"]

TOLERANCE = 0.004  # m; largest difference between the gap and a held object's width
CLEARANCE = 0.02  # m; spare room of an open hand, both sides together
# m; the hand may close this close to the grasp. The pads center what stands freely, and
# a policy with a pixel per centimeter hardly comes closer.
NEAR = 0.012
LOST = 0.025  # m; an object further from the pinch point is not in the hand
STRAIGHT = 0.25  # rad; largest twist of a closing hand: the pads turn what is free
ALIGNED, FUNNEL = 0.012, 0.05  # m; offsets up to which the tool goes in fully, at all
LEVER = 0.05  # m/rad; offset that a twist beyond half of the allowed one counts as


@dataclasses.dataclass
class Pinch:
  """A grip between the pads on something of known width, by a vertical tool.

  Raises:
    ConfigError: At this width, a grip looks like closed or open pads.
  """

  scene: Scene
  neutral_mat: Float[Array, "3 3"]  # the tool's rotation at heading zero
  _: dataclasses.KW_ONLY
  width: float  # m, of what is gripped
  hover: float  # m over the grasp at which the open finger tips clear the object
  travel: float  # m; tool height at which closed fingers clear everything
  above: float = 0.0  # m along the tool from the aimed point to the pads' center
  near: float = NEAR  # m
  straight: float = STRAIGHT  # rad
  depth: float = dataclasses.field(init=False)  # m, tool site back to the aimed point

  def __post_init__(self):
    model = self.scene.model
    joint = model.jnt_qposadr.tolist().index(self.scene.gripper_qpos)
    widest, narrowest = (float(pad_gap(x)) for x in model.jnt_range[joint])
    low, high = narrowest + TOLERANCE, widest - CLEARANCE
    if not low < self.width < high:
      raise ConfigError(
        f"{self.scene.name}.xml: the hand cannot grip what is {1e3 * self.width:g} mm "
        f"wide, only what is {1e3 * low:.1f} to {1e3 * high:.1f} mm wide"
      )
    self.depth = float(pinch_height(self.width)) - self.above

  def point(self, kinematics: Kinematics) -> Point:
    """Returns where the gripped point of an object in the hand is, m."""
    mat = kinematics.site_xmat[:, self.scene.tool_site]
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    return tool - self.depth * mat[:, :, 2]

  def twist(self, kinematics: Kinematics, heading: Angle, period: float) -> Angle:
    """Returns how far the hand is turned away from a heading, rad."""
    mat = kinematics.site_xmat[:, self.scene.tool_site] @ self.neutral_mat.T
    return geometry.fold(jnp.arctan2(mat[:, 1, 0], mat[:, 0, 0]) - heading, period)

  def is_open(self, state: PhysicsState) -> Mask:
    """Checks that the pads are clear of the object on both sides."""
    return is_open(self.scene, state, self.width)

  def holds(self, state: PhysicsState, kinematics: Kinematics, point: Point) -> Mask:
    """Checks that the pads grip something of this width at ``point`` (m)."""
    gripping = is_gripping(self.scene, state, self.width)
    return gripping & (geometry.norm(self.point(kinematics) - point) < LOST)

  def approach(
    self, state: PhysicsState, kinematics: Kinematics, aim: Point, twist: Angle
  ) -> Point:
    """Returns the tool position (m) that leads to a grip at ``aim`` and hits nothing.

    A low tool rises first. Over the object it descends through a funnel, unless the
    fingers are closed on nothing. Once around the object, it stays.
    """
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    off = geometry.norm(tool[:, :2] - aim[:, :2]) + off_by(twist, self.straight)
    height = geometry.funnel(off, aligned=ALIGNED, wide=FUNNEL)
    at_it = self.holds(state, kinematics, aim) | self.around(kinematics, aim, twist)
    height = self.hover * jnp.where(at_it | self.is_open(state), height, 1.0)
    down = geometry.at_height(aim[:, :2], aim[:, 2] - self.depth + height)
    return self._rise_first(tool, aim, down)

  def go_above(self, kinematics: Kinematics, place: Point) -> Point:
    """Returns the tool position (m) high over a place; a low tool rises first."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    return self._rise_first(tool, place, geometry.at_height(place[:, :2], self.travel))

  def _rise_first(self, tool: Array, place: Array, target: Array) -> Array:
    low = tool[:, 2] < self.travel - 0.02
    away = geometry.norm(tool[:, :2] - place[:, :2]) > FUNNEL
    rise = geometry.at_height(tool[:, :2], self.travel)
    return jnp.where((low & away)[:, None], rise, target)

  def around(self, kinematics: Kinematics, point: Point, twist: Angle) -> Mask:
    """Checks whether the hand may close to grip ``point`` (m)."""
    near = geometry.norm(self.point(kinematics) - point) < self.near
    return near & (jnp.abs(twist) < self.straight)


def off_by(twist: Angle, straight: float = STRAIGHT) -> Array:
  """Returns the offset (m) that a twist of the hand (rad) counts as."""
  return LEVER * jnp.maximum(jnp.abs(twist) - straight / 2, 0.0)


def grip(*, around: Mask, held: Mask, done: Mask) -> Float[Array, "worlds 3"]:
  """Returns the gripper commands of the primitives of a pick-and-place task.

  The hand closes around the object and opens where it is to be released (``done``). It
  is open in the neutral configuration.
  """
  close = (held | around) & ~done
  return jnp.stack([close, close, jnp.zeros_like(close)], 1).astype(jnp.float32)


def pick_and_place(
  primitives: Float[Array, "worlds 3 7"],
  *,
  held: Mask,
  done: Mask,
  is_open: Mask,
  withdraw: int = 2,
) -> Float[Array, "worlds 7"]:
  """Returns the actions of the scripted expert: reach, close, carry, open, withdraw.

  The primitive of index ``withdraw`` leads the open hand away.
  """
  # While the fingers open, stay with the object.
  choice = jnp.where(done, jnp.where(is_open, withdraw, 0), jnp.where(held, 1, 0))
  return jnp.take_along_axis(primitives, choice[:, None, None], axis=1)[:, 0]


def is_open(scene: Scene, state: PhysicsState, width: Array | float) -> Mask:
  """Checks that the pads are clear of something ``width`` (m) wide on both sides."""
  return state.qpos[:, scene.gripper_qpos] < finger_angle(width + CLEARANCE)


def is_gripping(scene: Scene, state: PhysicsState, width: Array | float) -> Mask:
  """Checks that the fingers have closed to ``width`` (m) and no further."""
  angle = state.qpos[:, scene.gripper_qpos]
  low, high = finger_angle(width + TOLERANCE), finger_angle(width - TOLERANCE)
  return (angle > low) & (angle < high)


def finger_angle(gap: Array | float) -> Array:
  """Returns the angle (rad) of the driven finger for a gap (m) between the pads."""
  return jnp.arccos((gap / 2 - 0.0041) / FINGER_LENGTH) - FINGER_ANGLE


def pad_gap(angle: Array | float) -> Array:
  """Returns the gap (m) between the pads, the inverse of ``finger_angle``."""
  return 2 * (0.0041 + FINGER_LENGTH * jnp.cos(angle + FINGER_ANGLE))


def pinch_height(gap: Array | float) -> Array:
  """Returns the distance (m) from the tool site back to the pads' center at a gap (m).

  The pads travel forward on an arc as the fingers close; the site is where their tips
  end when closed. Closed form of the maker's linkage.
  """
  angle = finger_angle(gap) + FINGER_ANGLE
  return 0.1449 - (0.078 + FINGER_LENGTH * jnp.sin(angle))
