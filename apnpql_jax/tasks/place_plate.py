"""Placing plate: take a plate out of its holder and put it into the goal box.

The plate stands on its edge and is gripped at the top of it by a tool that points down.
Primitives; following any one of them never knocks the plate over:

- object: go above the plate, turn the fingers across it and, through a funnel, go down
  until its edge is between the open pads; stay there.
- goal: with the plate in hand, lift it and, increasingly with height, move it toward
  the box; turn it across the box's longer side and, through a funnel, lower it to the
  floor. With empty hands, go above the box.
- neutral: the configuration of the keyframe.

A low tool away from the plate rises first; fingers closed on nothing do not descend.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.pinch import ALIGNED, FUNNEL, Pinch, grip, pick_and_place
from apnpql_jax.tasks.table_task import FreeBody, TableTask, draw_pair, yaw_quat
from apnpql_jax.tasks.task import ResetDraw, ToolTargets, register_task
from apnpql_jax.types import Array

WORKSPACE = ((0.40, 0.52), (-0.22, 0.22))  # m; x and y within a vertical tool's reach
HOLDER_YAW, BOX_YAW = 0.5, 0.3  # rad; largest yaw of each
MIN_DISTANCE = 0.26  # m; the box's outer corner (195 mm) and half the plate (65 mm)
THICKNESS = 0.012  # m; of the plate
RADIUS = 0.0647  # m; from the plate's center to the middle of a side of its octagon
GRASP_INSET = 0.013  # m from the edge to the center of the pads, which are 20 mm long
HOVER = 0.06  # m; height over the grasp at which the open finger tips clear the plate
TRAVEL = 0.22  # m; tool height at which closed fingers clear the plate (135 mm)
# m and rad; strict, as the pads can neither center nor turn a plate in its holder.
NEAR, STRAIGHT = 0.01, 0.12
LIFT = 0.085  # m; carrying height of a swinging plate over jaws and walls (35, 40 mm)
FREE = 0.04  # m; from this height on the plate moves sideways at full speed
INSIDE = (0.12, 0.085)  # m; half the inner length and width of the box
ON_FLOOR = 0.012  # m; largest height of the plate's lowest point at success
CLEAR = 0.05  # m; released when the pinch point is this far outside the grasp circle


@register_task
class PlacePlate(TableTask):
  """The task of this module; see ``tasks.task.Task``."""

  name = "place_plate"

  def __init__(self):
    super().__init__()
    self._plate = FreeBody(*self.scene.free_joint("plate"))
    self._goal, self._holder = self.scene.mocap("goal"), self.scene.mocap("holder")
    self._hand = Pinch(
      self.scene,
      self.neutral_mat,
      width=THICKNESS,
      hover=HOVER,
      travel=TRAVEL,
      near=NEAR,
      straight=STRAIGHT,
    )

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    holder, goal = draw_pair(rng, count, WORKSPACE, MIN_DISTANCE)
    qpos = self.draw_qpos(rng, count)
    holder_yaw, goal_yaw = (rng.uniform(-x, x, count) for x in (HOLDER_YAW, BOX_YAW))
    # A quarter turn about y puts the plate on its edge; then it turns with its holder.
    c, _, _, s = yaw_quat(holder_yaw).T
    self._plate.place(qpos, holder, np.stack([c, -s, c, s], -1) / np.sqrt(2))
    return self.reset_draw(
      qpos, (self._holder, holder, holder_yaw), (self._goal, goal, goal_yaw)
    )

  def tool_targets(self, state: PhysicsState, kinematics: Kinematics) -> ToolTargets:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    plate, goal = self._plate.pos(state), state.mocap_pos[:, self._goal]
    edge, yaw = self._edge(state), self._plate_yaw(state)
    twist = self._hand.twist(kinematics, yaw, np.pi)
    held = self._hand.holds(state, kinematics, edge)
    to_object = self._hand.approach(state, kinematics, edge, twist)

    # Goal: lift the plate out of its holder, then move sideways, then lower it.
    shift = goal - plate
    far = geometry.funnel(geometry.norm(shift[:, :2]), aligned=ALIGNED / 2, wide=FUNNEL)
    climb = RADIUS + 0.003 + LIFT * far - plate[:, 2]
    free = ((plate[:, 2] - RADIUS - 0.005) / (FREE - 0.005)).clip(0.0, 1.0)
    free = jnp.maximum(free, 1.0 - far)  # It may be low near its place.
    carry = tool + geometry.at_height(free[:, None] * shift[:, :2], climb)
    to_goal = jnp.where(held[:, None], carry, self._hand.go_above(kinematics, goal))

    # A plate that is still in its holder must not be turned.
    box_yaw = geometry.yaw(state.mocap_quat[:, self._goal])
    turn = jnp.where(held & (free < 1), yaw, box_yaw)
    turns = jnp.stack([yaw, turn, 0 * turn], 1)
    around = self._hand.around(kinematics, edge, twist)
    close = grip(around=around, held=held, done=self._in_box(state))
    positions = self.with_neutral(to_object, to_goal)
    return positions, geometry.rotation_z(turns) @ self.neutral_mat, close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that the plate is on the floor of the box, at rest and released."""
    distance = geometry.norm(self._hand.point(kinematics) - self._plate.pos(state))
    away = distance > RADIUS - GRASP_INSET + CLEAR
    return self._in_box(state) & self._plate.is_at_rest(state) & away

  def objects(self, state: PhysicsState) -> Array:
    """Returns points: the plate's center and axis, the box's center and longer side."""
    plate, goal = self._plate.pos(state), state.mocap_pos[:, self._goal]
    box_yaw = geometry.yaw(state.mocap_quat[:, self._goal])
    along = jnp.stack([jnp.cos(box_yaw), jnp.sin(box_yaw), 0 * box_yaw], -1)
    on_axis = plate + geometry.POINTER * self._axis(state)
    return jnp.concatenate([plate, on_axis, goal, goal + geometry.POINTER * along], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Picks the plate by its edge and places it in the box."""
    held = self._hand.holds(state, kinematics, self._edge(state))
    done, is_open = self._in_box(state), self._hand.is_open(state)
    return pick_and_place(primitives, held=held, done=done, is_open=is_open)

  def _axis(self, state: PhysicsState) -> Array:
    """Returns the axis of the disc, which has no sign."""
    return geometry.axis(self._plate.quat(state), 2)

  def _plate_yaw(self, state: PhysicsState) -> Array:
    """Returns the heading of the plate's axis, rad; 0 if it lies flat."""
    axis = self._axis(state)
    return geometry.fold(jnp.arctan2(axis[:, 1], axis[:, 0] + 1e-9), np.pi)

  def _edge(self, state: PhysicsState) -> Array:
    """Returns the grasp: below the highest point of the plate's edge."""
    axis = self._axis(state)
    slope = geometry.at_height(0 * axis[:, :2], 1.0) - axis[:, 2:] * axis
    top = slope / jnp.maximum(geometry.norm(slope), 0.1)[:, None]
    return self._plate.pos(state) + (RADIUS - GRASP_INSET) * top

  def _in_box(self, state: PhysicsState) -> Array:
    """Checks that the center is between the walls and the lowest point at the floor."""
    mat = geometry.rotation_z(geometry.yaw(state.mocap_quat[:, self._goal]))
    shift = self._plate.pos(state) - state.mocap_pos[:, self._goal]
    local = jnp.einsum("wji,wj->wi", mat, shift)
    tilt = jnp.abs(self._axis(state)[:, 2]).clip(0.0, 1.0)
    lowest = shift[:, 2] - RADIUS * jnp.sqrt(1 - tilt**2) - THICKNESS / 2 * tilt
    between = (jnp.abs(local[:, :2]) < jnp.asarray(INSIDE)).all(-1)
    return between & (lowest < ON_FLOOR)
