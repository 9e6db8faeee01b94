"""Flipping cup: turn a cup that stands on its mouth over and put it on the goal mark.

The cup has one of three shapes. It is gripped from the side, by a tool that points
away from the robot's base, so that half a turn of wrist 3 flips it. Primitives, so
that following one of them never knocks the cup over:

- object: go behind the cup, at the height of its middle, the fingers turned to its
  faces; then, through a funnel, forward until it is between the open pads; stay there.
- goal: with the cup in hand, lift it, the further the more it also turns and moves to
  the goal; once upright and over the goal, through a funnel, lower it; with empty
  hands, go behind the place over the goal, at the height of the hand.
- neutral: the configuration of the keyframe, tool horizontal.

Angles of the hand about its own axis are counted from the one with the closing plane
upright. A cup upside down is gripped at minus a quarter turn, where the camera is above
the hand; as the cup turns over, the hand turns to plus a quarter.
"""

from __future__ import annotations

from collections.abc import Callable
import functools

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.sim import arm
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry, pinch
from apnpql_jax.tasks.base import TableTask
from apnpql_jax.tasks.task import ResetDraw, register_task
from apnpql_jax.types import Array

SHAPES = ((8, 0.030, 0.130), (8, 0.037, 0.140), (4, 0.033, 0.150))
"""Sides, half the width across them in m, height in m of the three cups. Taller than
a mug: gripped in the middle, the hand must clear the table by its 27 mm and, at the
goal, by the 58 mm of the camera below it."""

RANGE = ((0.48, 0.60), (-0.5, 0.5))
"""m and rad; distance from the base's axis and direction of cup and goal. Nearer to
the base, wrist 2 of an arm that stands off the cup would have to be straight."""

MAX_YAW = 0.3
"""rad; the cup is turned away from the direction of reach by at most this."""

MIN_DISTANCE = 0.16
"""m between cup and goal: the mark and the widest cup apart."""

MASS = 0.025
"""kg, a plastic cup's (YCB: 13 to 38 g). Held by a horizontal tool it pulls with
0.06 N m on wrist 1, which the limit of acceleration lets resist with 0.14 N m."""

STANDOFF = 0.09
"""m; behind the cup by this much the open fingers are clear of it."""

LIFT = 0.07
"""m; how high the cup is carried: a cup and fingers that turn reach down 100 mm."""

FREE = 0.06
"""m; lifted this high, the cup is turned and moved at full speed."""

GOAL_TOLERANCE = 0.03
"""m; the cup's center from the goal's."""

UPRIGHT = 0.97
"""Cosine of the largest tilt of a cup that stands: 14 degrees."""

CLEAR = 0.05
"""m; the gripper has let go when its pinch point is this far from the cup's axis."""


def shape_cup(spec: mujoco.MjSpec, sides: int, half: float, height: float) -> None:
  """Gives the cup of a parsed scene one of the shapes."""
  cup = spec.body("cup")
  cup.mass = MASS
  # A solid cylinder's; the wall alone would be a little more.
  side = MASS * (3 * half**2 + height**2) / 12
  cup.inertia = [side, side, MASS * half**2 / 2]
  # A side of a regular polygon is 2 tan(pi / n) of its distance to the center.
  across = half * np.tan(np.pi / sides)
  for i in range(4):
    turned = sides == 4 and i % 2 == 1  # The two diagonal boxes hide in a square.
    size = [0.7 * half, 0.7 * half] if turned else [half, across]
    spec.geom(f"cup_{i}").size = [*size, height / 2]
  mouth = spec.geom("mouth")
  mouth.size = [0.85 * half, 0.001, 0]
  mouth.pos = [0, 0, height / 2 + 0.0001]


def _edit(shape: tuple[int, float, float]) -> Callable[[mujoco.MjSpec], None]:
  return functools.partial(shape_cup, sides=shape[0], half=shape[1], height=shape[2])


@register_task
class FlipCup(TableTask):
  """See the module's docstring; implements ``tasks.task.Task``."""

  name = "flip_cup"
  arm_noise = 0.1

  def __init__(self):
    super().__init__([_edit(shape) for shape in SHAPES])
    self._cup, self._cup_dof = self.scene.free_joint("cup")
    self._wall = self.scene.id("geom", "cup_0")
    self._goal = self.scene.mocap("goal")

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``; ranges are polar, around the robot's base."""
    low, high = np.array(RANGE).T
    cup, goal = _from_polar(rng.uniform(low, high, (2, count, 2)))
    while (near := np.linalg.norm(cup - goal, axis=-1) < MIN_DISTANCE).any():
      again = rng.uniform(low, high, (2, int(near.sum()), 2))
      cup[near], goal[near] = _from_polar(again)
    variant = rng.integers(len(SHAPES), size=count)
    qpos = self.draw_qpos(rng, count)
    qpos[:, self._cup : self._cup + 2] = cup
    qpos[:, self._cup + 2] = np.array(SHAPES)[variant, 2] / 2
    heading = np.arctan2(cup[:, 1], cup[:, 0]) + rng.uniform(-MAX_YAW, MAX_YAW, count)
    # Half a turn about the x axis, then ``heading`` about the vertical.
    qpos[:, self._cup + 3] = 0
    qpos[:, self._cup + 4], qpos[:, self._cup + 5] = (
      np.cos(heading / 2),
      np.sin(heading / 2),
    )
    qpos[:, self._cup + 6] = 0
    mocap_pos, mocap_quat = np.zeros((count, 1, 3)), np.zeros((count, 1, 4))
    mocap_pos[:, self._goal, :2], mocap_quat[..., 0] = goal, 1
    return ResetDraw(qpos, mocap_pos, mocap_quat, variant)

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    cup, goal = self._cup_pos(state), state.mocap_pos[:, self._goal]
    half, middle = self._half_width(state), self._half_height(state)
    held = self._held(state, kinematics)
    reach = self._reach(state, kinematics)
    flip = self._flip(state, reach)
    roll = flip - np.pi / 2

    depth = pinch.pinch_height(2 * half)[:, None]
    grasp = cup + depth * reach
    missing = tool - grasp
    along = (missing * reach).sum(-1, keepdims=True)
    off = geometry.norm(missing - along * reach)
    off = off + pinch.off_by(self._turned_away(kinematics, reach, roll))
    back = geometry.funnel(off, aligned=pinch.ALIGNED, wide=pinch.FUNNEL)
    around = self._around(state, kinematics)
    may_enter = held | around | self._is_open(state)
    back = STANDOFF * jnp.where(may_enter, back, 1.0)[:, None]
    to_object = grasp - back * reach

    outward = _direction(goal)
    shift = goal[:, :2] - cup[:, :2]
    far = geometry.norm(shift) + pinch.LEVER * (np.pi - flip)
    far = geometry.funnel(far, aligned=pinch.ALIGNED, wide=pinch.FUNNEL)
    lifted = cup[:, 2] - middle
    free = ((lifted - 0.01) / (FREE - 0.01)).clip(0.0, 1.0)
    free = jnp.maximum(free, 1.0 - far)  # Close to its place it may be low.
    climb = 0.002 + LIFT * far - lifted
    over = goal + geometry.up(0 * shift, cup[:, 2] + climb) + depth * outward
    here = tool + geometry.up(0 * shift, climb)
    carry = here + free[:, None] * (over - here)
    empty = goal + geometry.up(0 * shift, tool[:, 2]) - STANDOFF * outward
    to_goal = jnp.where(held[:, None], carry, empty)

    turn = jnp.where(held, roll + free * (np.pi / 2 - roll), self._empty_roll(flip))
    heading = jnp.where((held & (free < 1))[:, None], reach, outward)
    rotations = [
      _hand(reach, roll),
      _hand(heading, turn),
      jnp.broadcast_to(self._neutral_mat, (*roll.shape, 3, 3)),
    ]
    positions = self.with_neutral(to_object, to_goal)
    close = pinch.grip(around=around, held=held, done=self._placed(state))
    return positions, jnp.stack(rotations, 1), close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """The cup stands upright on the goal, at rest, and the gripper has let go."""
    at_rest = geometry.is_at_rest(state.qvel[:, self._cup_dof : self._cup_dof + 6])
    away = geometry.norm(self._pinch_point(state, kinematics) - self._cup_pos(state))
    return self._placed(state) & at_rest & (away > CLEAR)

  def objects(self, state: PhysicsState) -> Array:
    """f32[worlds, 12]: cup's center, a point towards its mouth, the goal, and a point
    half the cup's width beside its center and half its height above, m."""
    cup = self._cup_pos(state)
    to_mouth = cup + geometry.POINTER * self._axis(state)
    width, height = self._half_width(state), self._half_height(state)
    corner = cup + jnp.stack([width, 0 * width, height], -1)
    goal = state.mocap_pos[:, self._goal]
    return jnp.concatenate([cup, to_mouth, goal, corner], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Pick the cup, flip and place it; withdraw with what goes behind the goal."""
    return pinch.pick_and_place(
      primitives,
      held=self._held(state, kinematics),
      done=self._placed(state),
      is_open=self._is_open(state),
      withdraw=1,
    )

  def _cup_pos(self, state: PhysicsState) -> Array:
    return state.qpos[:, self._cup : self._cup + 3]

  def _half_width(self, state: PhysicsState) -> Array:
    return state.fields["geom_size"][:, self._wall, 0]

  def _half_height(self, state: PhysicsState) -> Array:
    return state.fields["geom_size"][:, self._wall, 2]

  def _axis(self, state: PhysicsState) -> Array:
    """From the cup's bottom to its mouth."""
    return geometry.axis(state.qpos[:, self._cup + 3 : self._cup + 7], 2)

  def _reach(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Horizontal direction of the grasp: away from the base and square to a face of
    the cup; with the cup in hand, where the hand points."""
    outward = _direction(self._cup_pos(state))
    radial = jnp.arctan2(outward[:, 1], outward[:, 0])
    face = geometry.axis(state.qpos[:, self._cup + 3 : self._cup + 7], 0)
    heading = jnp.arctan2(face[:, 1], face[:, 0])
    heading = radial + geometry.fold(heading - radial, np.pi / 2)
    square = jnp.stack([jnp.cos(heading), jnp.sin(heading), 0 * heading], -1)
    hand = _direction(kinematics.site_xmat[:, self.scene.tool_site, :, 2])
    return jnp.where(self._held(state, kinematics)[:, None], hand, square)

  def _flip(self, state: PhysicsState, reach: Array) -> Array:
    """Angle of the cup about the reach: 0 upside down, pi upright, rad."""
    axis = self._axis(state)
    left = jnp.stack([-reach[:, 1], reach[:, 0], 0 * reach[:, 0]], -1)
    # Turning -z about the reach leads over the left to +z.
    angle = jnp.arctan2((axis * left).sum(-1), -axis[:, 2])
    # From a little on the wrong side of either end, the end.
    return jnp.where(angle < -np.pi / 2, np.pi, angle.clip(0.0, np.pi))

  def _empty_roll(self, flip: Array) -> Array:
    """Roll of an empty hand at the goal: that of its last grip if a cup stands."""
    return jnp.where(flip > 0.9 * np.pi, np.pi / 2, 0.0)

  def _pinch_point(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Where the axis of a cup in the hand is."""
    mat = kinematics.site_xmat[:, self.scene.tool_site]
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    depth = pinch.pinch_height(2 * self._half_width(state))
    return tool - depth[:, None] * mat[:, :, 2]

  def _is_open(self, state: PhysicsState) -> Array:
    return pinch.is_open(self.scene, state, 2 * self._half_width(state))

  def _held(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    gripping = pinch.is_gripping(self.scene, state, 2 * self._half_width(state))
    offset = self._pinch_point(state, kinematics) - self._cup_pos(state)
    return gripping & (geometry.norm(offset) < pinch.LOST)

  def _around(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    offset = self._pinch_point(state, kinematics) - self._cup_pos(state)
    reach = self._reach(state, kinematics)
    roll = self._flip(state, reach) - np.pi / 2
    straight = self._turned_away(kinematics, reach, roll) < pinch.STRAIGHT
    return (geometry.norm(offset) < pinch.NEAR) & straight

  def _turned_away(self, kinematics: Kinematics, reach: Array, roll: Array) -> Array:
    """Angle between the hand and how it shall be, rad."""
    mat = kinematics.site_xmat[:, self.scene.tool_site]
    return geometry.norm(arm.rotation_error(mat, _hand(reach, roll)))

  def _placed(self, state: PhysicsState) -> Array:
    shift = self._cup_pos(state) - state.mocap_pos[:, self._goal]
    on_table = jnp.abs(shift[:, 2] - self._half_height(state)) < 0.01
    near = geometry.norm(shift[:, :2]) < GOAL_TOLERANCE
    return near & on_table & (self._axis(state)[:, 2] > UPRIGHT)


def _from_polar(polar: np.ndarray) -> np.ndarray:
  """f64[*b, 2] radius and direction -> f64[*b, 2] x and y."""
  radius, direction = np.moveaxis(polar, -1, 0)
  return np.stack([radius * np.cos(direction), radius * np.sin(direction)], -1)


def _direction(vector: Array) -> Array:
  """Horizontal unit vector along a vector, such as from the base to a point."""
  xy = vector[:, :2] / geometry.norm(vector[:, :2])[:, None]
  return geometry.up(xy, 0.0)


def _hand(reach: Array, roll: Array) -> Array:
  """Rotation of a tool along ``reach``, turned by ``roll`` from an upright plane.

  f32[worlds, 3], f32[worlds] -> f32[worlds, 3, 3].
  """
  up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), reach.shape)
  left = jnp.cross(up, reach)
  c, s = jnp.cos(roll)[:, None], jnp.sin(roll)[:, None]
  return jnp.stack([c * left + s * up, -s * left + c * up, reach], -1)
