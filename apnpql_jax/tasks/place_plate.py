"""Picking and placing plate: take it out of its holder and put it into the goal box.

The plate stands on its edge; it is gripped at the top of the edge by a tool that
points down. Primitives, so that following one of them never knocks the plate over:

- object: go above the plate, turn the fingers across it and, through a funnel, down
  until its edge is between the open pads; stay there.
- goal: with the plate in hand, lift it, the further the more it also moves towards
  the box, turn it across the box's longer side and, through a funnel, lower it to the
  floor; with empty hands, go above the box.
- neutral: the configuration of the keyframe.

A low tool that is not at the plate rises first; fingers that are closed on nothing do
not descend.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.base import TableTask
from apnpql_jax.tasks.pinch import ALIGNED, FUNNEL, Pinch, grip, pick_and_place
from apnpql_jax.tasks.task import ResetDraw, register_task
from apnpql_jax.types import Array

WORKSPACE = ((0.40, 0.52), (-0.22, 0.22))
"""m; x and y ranges of the holder and the box, within reach of a vertical tool."""

HOLDER_YAW, BOX_YAW = 0.5, 0.3
"""rad; turned by at most this."""

MIN_DISTANCE = 0.26
"""m between holder and box: half the box's diagonal (154 mm), the plate, fingers."""

THICKNESS = 0.012
"""m; of the plate."""

RADIUS = 0.0647
"""m; from the plate's center to the middle of a side of its octagon."""

GRASP_INSET = 0.013
"""m from the plate's edge to the pads' center: the pads are 20 mm long."""

HOVER = 0.06
"""m; height over the grasp at which the open finger tips clear the plate."""

TRAVEL = 0.22
"""m; tool height at which closed fingers clear the standing plate (135 mm)."""

NEAR, STRAIGHT = 0.01, 0.12
"""m and rad; closer than for what stands freely: the holder keeps the plate from being
centered and turned by the pads."""

LIFT = 0.085
"""m; how high the plate is carried, swinging: jaws and walls are 35 and 40 mm high."""

FREE = 0.04
"""m; lifted this high, the plate moves sideways at full speed."""

INSIDE = (0.12, 0.085)
"""m; half the inner length and width of the box."""

ON_FLOOR = 0.012
"""m; success allows the plate's lowest point this far above the table."""

CLEAR = 0.05
"""m; the gripper has let go when its pinch point is this far outside of the circle
where it gripped the plate."""


@register_task
class PlacePlate(TableTask):
  """See the module's docstring; implements ``tasks.task.Task``."""

  name = "place_plate"

  def __init__(self):
    super().__init__()
    self._plate, self._plate_dof = self.scene.free_joint("plate")
    self._goal, self._holder = self.scene.mocap("goal"), self.scene.mocap("holder")
    self._hand = Pinch(
      self.scene,
      self._neutral_mat,
      width=THICKNESS,
      above=0.0,
      hover=HOVER,
      travel=TRAVEL,
      near=NEAR,
      straight=STRAIGHT,
    )

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    low, high = np.array(WORKSPACE).T
    holder, goal = rng.uniform(low, high, (2, count, 2))
    while (near := np.linalg.norm(holder - goal, axis=-1) < MIN_DISTANCE).any():
      holder[near], goal[near] = rng.uniform(low, high, (2, int(near.sum()), 2))
    qpos = self.draw_qpos(rng, count)
    pos, quat = np.zeros((count, 2, 3)), np.zeros((count, 2, 4))
    for index, spot, spread in (
      (self._holder, holder, HOLDER_YAW),
      (self._goal, goal, BOX_YAW),
    ):
      half = rng.uniform(-spread, spread, count) / 2
      pos[:, index, :2] = spot
      quat[:, index, 0], quat[:, index, 3] = np.cos(half), np.sin(half)
    qpos[:, self._plate : self._plate + 2] = holder
    # Turned about the vertical after being put on its edge by a quarter turn about y.
    c, s = quat[:, self._holder, 0], quat[:, self._holder, 3]
    standing = np.stack([c, -s, c, s], -1) / np.sqrt(2)
    qpos[:, self._plate + 3 : self._plate + 7] = standing
    return ResetDraw(qpos, pos, quat, np.zeros(count, int))

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    plate, goal = self._plate_pos(state), state.mocap_pos[:, self._goal]
    edge = self._edge(state)
    twist = self._hand.twist(kinematics, self._plate_yaw(state), np.pi)
    held = self._hand.holds(state, kinematics, edge)
    to_object = self._hand.approach(state, kinematics, edge, twist)

    shift = goal - plate
    far = geometry.funnel(geometry.norm(shift[:, :2]), aligned=ALIGNED / 2, wide=FUNNEL)
    climb = RADIUS + 0.003 + LIFT * far - plate[:, 2]
    free = ((plate[:, 2] - RADIUS - 0.005) / (FREE - 0.005)).clip(0.0, 1.0)
    free = jnp.maximum(free, 1.0 - far)  # Close to its place it may be low.
    carry = tool + geometry.up(free[:, None] * shift[:, :2], climb)
    to_goal = jnp.where(held[:, None], carry, self._hand.above(kinematics, goal))

    positions = self.with_neutral(to_object, to_goal)
    box_yaw = geometry.yaw(state.mocap_quat[:, self._goal])
    # A plate that is still in its holder must not be turned.
    turn = jnp.where(held & (free < 1), self._plate_yaw(state), box_yaw)
    turns = jnp.stack([self._plate_yaw(state), turn, 0 * turn], 1)
    close = grip(
      around=self._hand.around(kinematics, edge, twist),
      held=held,
      done=self._in_box(state),
    )
    return positions, geometry.turn_z(turns) @ self._neutral_mat, close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """The plate is in the box, on its floor, at rest, and the gripper has let go."""
    at_rest = geometry.is_at_rest(state.qvel[:, self._plate_dof : self._plate_dof + 6])
    distance = geometry.norm(self._hand.point(kinematics) - self._plate_pos(state))
    return self._in_box(state) & at_rest & (distance > RADIUS - GRASP_INSET + CLEAR)

  def objects(self, state: PhysicsState) -> Array:
    """f32[worlds, 12]: center of the plate and a point on its axis, the same for the
    box and its longer side, m."""
    plate, goal = self._plate_pos(state), state.mocap_pos[:, self._goal]
    box_yaw = geometry.yaw(state.mocap_quat[:, self._goal])
    along = jnp.stack([jnp.cos(box_yaw), jnp.sin(box_yaw), 0 * box_yaw], -1)
    on_axis = plate + geometry.POINTER * self._axis(state)
    return jnp.concatenate([plate, on_axis, goal, goal + geometry.POINTER * along], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Pick the plate by its edge, place it in the box."""
    return pick_and_place(
      primitives,
      held=self._hand.holds(state, kinematics, self._edge(state)),
      done=self._in_box(state),
      is_open=self._hand.is_open(state),
    )

  def _plate_pos(self, state: PhysicsState) -> Array:
    return state.qpos[:, self._plate : self._plate + 3]

  def _axis(self, state: PhysicsState) -> Array:
    """Of the disc, without a sign."""
    return geometry.axis(state.qpos[:, self._plate + 3 : self._plate + 7], 2)

  def _plate_yaw(self, state: PhysicsState) -> Array:
    """Heading of the plate's axis, which has no sign; 0 if it lies flat."""
    axis = self._axis(state)
    return geometry.fold(jnp.arctan2(axis[:, 1], axis[:, 0] + 1e-9), np.pi)

  def _edge(self, state: PhysicsState) -> Array:
    """Where the pads shall meet the plate: below the top of its edge."""
    axis = self._axis(state)
    slope = geometry.up(0 * axis[:, :2], 1.0) - axis[:, 2:] * axis
    top = slope / jnp.maximum(geometry.norm(slope), 0.1)[:, None]
    return self._plate_pos(state) + (RADIUS - GRASP_INSET) * top

  def _in_box(self, state: PhysicsState) -> Array:
    """The plate's center is between the walls and its lowest point at the floor."""
    mat = geometry.turn_z(geometry.yaw(state.mocap_quat[:, self._goal]))
    shift = self._plate_pos(state) - state.mocap_pos[:, self._goal]
    local = jnp.einsum("wji,wj->wi", mat, shift)
    tilt = jnp.abs(self._axis(state)[:, 2]).clip(0.0, 1.0)
    lowest = shift[:, 2] - RADIUS * jnp.sqrt(1 - tilt**2) - THICKNESS / 2 * tilt
    between = (jnp.abs(local[:, :2]) < jnp.asarray(INSIDE)).all(-1)
    return between & (lowest < ON_FLOOR)
