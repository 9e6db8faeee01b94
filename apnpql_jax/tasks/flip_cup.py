"""Flipping cup: turn over a cup that stands on its mouth and put it on the goal mark.

The cup has one of three shapes. A tool that points away from the robot's base grips it
from the side, so that half a turn of wrist 3 flips it. Primitives; following any one of
them never knocks the cup over:

- object: go behind the cup, at half its height, the fingers aligned with its faces;
  then, through a funnel, go forward until it is between the open pads; stay there.
- goal: with the cup in hand, lift it and, increasingly with height, turn it and move it
  to the goal; once it is upright and over the goal, lower it through a funnel. With
  empty hands, go behind the goal at the height of the hand.
- neutral: the configuration of the keyframe, tool horizontal.

The roll of the hand about its own axis is zero where the closing plane is vertical. A
cup upside down is gripped at a roll of minus a quarter turn, with the camera above the
hand; as the cup turns over, the roll goes to plus a quarter turn.
"""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.sim import arm
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry, pinch
from apnpql_jax.tasks.table_task import FreeBody, TableTask, draw_pair
from apnpql_jax.tasks.task import ResetDraw, ToolTargets, register_task
from apnpql_jax.types import Array

# Sides, half the width across them (m) and height (m) of the cups. Taller than a mug:
# at half the height, the hand (27 mm) and the camera below it (58 mm) clear the table.
SHAPES = ((8, 0.030, 0.130), (8, 0.037, 0.140), (4, 0.033, 0.150))
# m and rad, around the base. Nearer, wrist 2 would be straight at ``STANDOFF``.
RANGE = ((0.48, 0.60), (-0.5, 0.5))
MAX_YAW = 0.3  # rad; largest yaw of the cup away from the direction of reach
MIN_DISTANCE = 0.16  # m between cup and goal: the mark clears the widest cup
# kg, of a plastic cup (YCB: 13 to 38 g). In a horizontal tool it loads wrist 1 with
# 0.06 N m, of the 0.14 N m that the limit of acceleration leaves it.
MASS = 0.025
STANDOFF = 0.09  # m; this far behind the cup the open fingers are clear of it
LIFT = 0.1  # m; carrying height; at 0.07 agents let cups touch the table on the way
FREE = 0.06  # m; from this height on the cup is turned and moved at full speed
GOAL_TOLERANCE = 0.03  # m between the centers of cup and goal
UPRIGHT = 0.97  # cosine of the largest tilt of a cup that stands: 14 degrees
CLEAR = 0.05  # m from the cup to the pinch point of a hand that has let go


def shape_cup(spec: mujoco.MjSpec, sides: int, half: float, height: float) -> None:
  """Gives the cup of a parsed scene one of the ``SHAPES``."""
  cup = spec.body("cup")
  cup.mass = MASS
  # Inertia of a solid cylinder; that of the wall alone would be a little more.
  side = MASS * (3 * half**2 + height**2) / 12
  cup.inertia = [side, side, MASS * half**2 / 2]
  # A side of a regular polygon is 2 tan(pi / n) of its distance to the center.
  across = half * np.tan(np.pi / sides)
  for i in range(4):
    turned = sides == 4 and i % 2 == 1  # Hides the two diagonal boxes in a square.
    size = [0.7 * half, 0.7 * half] if turned else [half, across]
    spec.geom(f"cup_{i}").size = [*size, height / 2]
  mouth = spec.geom("mouth")
  mouth.size = [0.85 * half, 0.001, 0]
  mouth.pos = [0, 0, height / 2 + 0.0001]


@register_task
class FlipCup(TableTask):
  """The task of this module; see ``tasks.task.Task``."""

  name = "flip_cup"
  arm_noise = 0.1

  def __init__(self):
    super().__init__([lambda spec, shape=x: shape_cup(spec, *shape) for x in SHAPES])
    self._cup = FreeBody(*self.scene.free_joint("cup"))
    self._wall = self.scene.id("geom", "cup_0")
    self._goal = self.scene.mocap("goal")

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``; ranges are polar, around the robot's base."""
    cup, goal = draw_pair(rng, count, RANGE, MIN_DISTANCE, _from_polar)
    variant = rng.integers(len(SHAPES), size=count)
    qpos = self.draw_qpos(rng, count)
    heading = np.arctan2(cup[:, 1], cup[:, 0]) + rng.uniform(-MAX_YAW, MAX_YAW, count)
    # Half a turn about the x axis, then ``heading`` about the vertical.
    c, s, zero = np.cos(heading / 2), np.sin(heading / 2), np.zeros(count)
    self._cup.place(qpos, cup, np.stack([zero, c, s, zero], -1))
    qpos[:, self._cup.qpos + 2] = np.array(SHAPES)[variant, 2] / 2
    return self.reset_draw(qpos, (self._goal, goal, 0.0), variant=variant)

  def tool_targets(self, state: PhysicsState, kinematics: Kinematics) -> ToolTargets:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    cup, goal = self._cup.pos(state), state.mocap_pos[:, self._goal]
    half, middle = self._half_size(state)
    held = self._held(state, kinematics)
    reach = self._reach(state, kinematics, held)
    flip = self._flip(state, reach)
    roll = flip - np.pi / 2
    depth = pinch.pinch_height(2 * half)[:, None]
    mat = kinematics.site_xmat[:, self.scene.tool_site]
    misaligned = geometry.norm(arm.rotation_error(mat, _hand(reach, roll)))
    near = geometry.norm(self._offset(state, kinematics)) < pinch.NEAR
    around = near & (misaligned < pinch.STRAIGHT)

    # Object: stand off the cup until the hand is aligned, then go forward.
    grasp = cup + depth * reach
    missing = tool - grasp
    along = (missing * reach).sum(-1, keepdims=True)
    off = geometry.norm(missing - along * reach) + pinch.off_by(misaligned)
    back = geometry.funnel(off, aligned=pinch.ALIGNED, wide=pinch.FUNNEL)
    may_enter = held | around | self._is_open(state)
    back = STANDOFF * jnp.where(may_enter, back, 1.0)[:, None]
    to_object = grasp - back * reach

    # Goal: lift the cup, then turn and move it, then lower it.
    outward = _direction(goal)
    shift = goal[:, :2] - cup[:, :2]
    far = geometry.norm(shift) + pinch.LEVER * (np.pi - flip)
    far = geometry.funnel(far, aligned=pinch.ALIGNED, wide=pinch.FUNNEL)
    lifted = cup[:, 2] - middle
    free = ((lifted - 0.01) / (FREE - 0.01)).clip(0.0, 1.0)
    free = jnp.maximum(free, 1.0 - far)  # It may be low near its place.
    climb = 0.002 + LIFT * far - lifted
    over = goal + geometry.at_height(0 * shift, cup[:, 2] + climb) + depth * outward
    here = tool + geometry.at_height(0 * shift, climb)
    carry = here + free[:, None] * (over - here)
    empty = goal + geometry.at_height(0 * shift, tool[:, 2]) - STANDOFF * outward
    to_goal = jnp.where(held[:, None], carry, empty)

    # An empty hand keeps the roll of its last grip if the cup stands upright.
    empty_roll = jnp.where(flip > 0.9 * np.pi, np.pi / 2, 0.0)
    turn = jnp.where(held, roll + free * (np.pi / 2 - roll), empty_roll)
    heading = jnp.where((held & (free < 1))[:, None], reach, outward)
    at_object, at_goal = _hand(reach, roll), _hand(heading, turn)
    neutral = jnp.broadcast_to(self.neutral_mat, (*roll.shape, 3, 3))
    positions = self.with_neutral(to_object, to_goal)
    close = pinch.grip(around=around, held=held, done=self._placed(state))
    return positions, jnp.stack([at_object, at_goal, neutral], 1), close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that the cup stands upright on the goal, at rest and released."""
    away = geometry.norm(self._offset(state, kinematics)) > CLEAR
    return self._placed(state) & self._cup.is_at_rest(state) & away

  def objects(self, state: PhysicsState) -> Array:
    """Returns the cup's center, a point toward its mouth, the goal, and a corner."""
    cup, (width, height) = self._cup.pos(state), self._half_size(state)
    to_mouth = cup + geometry.POINTER * self._axis(state)
    corner = cup + jnp.stack([width, 0 * width, height], -1)
    goal = state.mocap_pos[:, self._goal]
    return jnp.concatenate([cup, to_mouth, goal, corner], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Picks, flips and places the cup; withdraws with the goal primitive."""
    held, done = self._held(state, kinematics), self._placed(state)
    is_open = self._is_open(state)
    return pinch.pick_and_place(
      primitives, held=held, done=done, is_open=is_open, withdraw=1
    )

  def _half_size(self, state: PhysicsState) -> tuple[Array, Array]:
    """Returns half the width and half the height of the cup, m."""
    size = state.fields["geom_size"][:, self._wall]
    return size[:, 0], size[:, 2]

  def _axis(self, state: PhysicsState) -> Array:
    """Returns the direction from the cup's bottom to its mouth."""
    return geometry.axis(self._cup.quat(state), 2)

  def _reach(self, state: PhysicsState, kinematics: Kinematics, held: Array) -> Array:
    """Returns the grasp's direction: outward, square to a face; if held, the hand's."""
    outward = _direction(self._cup.pos(state))
    radial = jnp.arctan2(outward[:, 1], outward[:, 0])
    face = geometry.axis(self._cup.quat(state), 0)
    heading = jnp.arctan2(face[:, 1], face[:, 0])
    heading = radial + geometry.fold(heading - radial, np.pi / 2)
    square = jnp.stack([jnp.cos(heading), jnp.sin(heading), 0 * heading], -1)
    hand = _direction(kinematics.site_xmat[:, self.scene.tool_site, :, 2])
    return jnp.where(held[:, None], hand, square)

  def _flip(self, state: PhysicsState, reach: Array) -> Array:
    """Returns the angle of the cup about the reach, rad: 0 upside down, pi upright."""
    axis = self._axis(state)
    left = jnp.stack([-reach[:, 1], reach[:, 0], 0 * reach[:, 0]], -1)
    # Turning -z about the reach leads over the left to +z.
    angle = jnp.arctan2((axis * left).sum(-1), -axis[:, 2])
    # Slightly past either end counts as that end.
    return jnp.where(angle < -np.pi / 2, np.pi, angle.clip(0.0, np.pi))

  def _offset(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Returns the vector from the cup's center to the pinch point, m."""
    mat = kinematics.site_xmat[:, self.scene.tool_site]
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    depth = pinch.pinch_height(2 * self._half_size(state)[0])
    return tool - depth[:, None] * mat[:, :, 2] - self._cup.pos(state)

  def _is_open(self, state: PhysicsState) -> Array:
    """Checks that the pads are clear of the cup."""
    return pinch.is_open(self.scene, state, 2 * self._half_size(state)[0])

  def _held(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that the cup is in the hand."""
    gripping = pinch.is_gripping(self.scene, state, 2 * self._half_size(state)[0])
    return gripping & (geometry.norm(self._offset(state, kinematics)) < pinch.LOST)

  def _placed(self, state: PhysicsState) -> Array:
    """Checks that the cup stands upright on the goal."""
    shift = self._cup.pos(state) - state.mocap_pos[:, self._goal]
    on_table = jnp.abs(shift[:, 2] - self._half_size(state)[1]) < 0.01
    near = geometry.norm(shift[:, :2]) < GOAL_TOLERANCE
    return near & on_table & (self._axis(state)[:, 2] > UPRIGHT)


def _from_polar(polar: np.ndarray) -> np.ndarray:
  """Converts f64[*b, 2] from radius and direction to x and y."""
  radius, direction = np.moveaxis(polar, -1, 0)
  return np.stack([radius * np.cos(direction), radius * np.sin(direction)], -1)


def _direction(vector: Array) -> Array:
  """Returns the horizontal unit vector along f32[worlds, >= 2]."""
  xy = vector[:, :2] / geometry.norm(vector[:, :2])[:, None]
  return geometry.at_height(xy, 0.0)


def _hand(reach: Array, roll: Array) -> Array:
  """Returns the rotation of a tool along ``reach`` at a roll, f32[worlds, 3, 3]."""
  up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), reach.shape)
  left = jnp.cross(up, reach)
  c, s = jnp.cos(roll)[:, None], jnp.sin(roll)[:, None]
  return jnp.stack([c * left + s * up, -s * left + c * up, reach], -1)
