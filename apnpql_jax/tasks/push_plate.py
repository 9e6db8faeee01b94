"""Pushing plate: drag a rimmed plate onto the goal mark from inside its rim.

Primitives, so that following one of them never knocks the plate over:

- object: go above the plate and, through a funnel, down to its floor until the closed
  finger tips are inside the rim; from inside, move to the plate's center.
- goal: from inside the rim, move by what the plate still lacks to the goal, so the
  plate is dragged along, the slower the less deep the tool is; from elsewhere, go
  above the goal.
- neutral: the configuration of the keyframe.

The fingers stay closed. A tool that is low but outside the plate rises first. While
dragging, the target is a waypoint at most ``LOOKAHEAD`` ahead, because a straight
line in joint space bends away from one on the table by L^2 / 8r (1.2 mm for 0.07 m at
0.5 m).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.base import TableTask
from apnpql_jax.tasks.task import ResetDraw, register_task
from apnpql_jax.types import Array

WORKSPACE = ((0.36, 0.58), (-0.24, 0.24))
"""m; x and y ranges of plate and goal, within reach of a vertical tool."""

MIN_DISTANCE = 0.12
"""m between plate and goal: four times the goal's tolerance."""

GOAL_TOLERANCE = 0.03
"""m; the mark's radius exceeds the plate's by this much: solved = inside the mark."""

FLAT = 0.97
"""Cosine of the largest tilt of a plate that lies flat: 14 degrees. Upside down its
center is as low as ever, because only its floor touches the table."""

HOVER_HEIGHT = 0.08
"""m; tool height at which the finger tips clear the rim (34 mm)."""

CLEAR = 0.05
"""m; above this the tool may travel without touching the rim."""

DRAG_HEIGHT = 0.012
"""m; 6 mm above the plate's floor, the tips' sides against the rim."""

LOW = 0.03
"""m; below this the tips are behind the rim (center line at 22 mm): dragging starts."""

INSIDE = 0.083
"""m; radius of the rim's center line: a low tool closer than this is inside."""

CAPTURE = 0.06
"""m; a tool below this and within the rim goes down to drag, whatever primitive it
follows. Well above the drag height, because a policy that misjudges where the
primitives turn round would lift the tool off the plate."""

ALIGNED = 0.02
"""m; this close to the plate's axis the tool descends: 33 mm between tips and rim."""

FUNNEL = 0.055
"""m; from here to ``ALIGNED`` the height falls linearly. A step would be sharper than
a network can see in the images."""

LOOKAHEAD = 0.07
"""m; longest step of a dragging tool's waypoint."""


@register_task
class PushPlate(TableTask):
  """See the module's docstring; implements ``tasks.task.Task``."""

  name = "push_plate"

  def __init__(self):
    super().__init__()
    self._plate, self._plate_dof = self.scene.free_joint("plate")
    self._goal = self.scene.mocap("goal")

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    low, high = np.array(WORKSPACE).T
    plate, goal = rng.uniform(low, high, (2, count, 2))
    while (near := np.linalg.norm(plate - goal, axis=-1) < MIN_DISTANCE).any():
      plate[near], goal[near] = rng.uniform(low, high, (2, int(near.sum()), 2))
    qpos = self.draw_qpos(rng, count)
    qpos[:, self._plate : self._plate + 2] = plate
    yaw = rng.uniform(-np.pi, np.pi, count)
    qpos[:, self._plate + 3] = np.cos(yaw / 2)
    qpos[:, self._plate + 6] = np.sin(yaw / 2)
    mocap_pos = np.zeros((count, self.scene.model.nmocap, 3))
    mocap_pos[:, self._goal, :2] = goal
    mocap_quat = np.zeros((count, self.scene.model.nmocap, 4))
    mocap_quat[..., 0] = 1
    return ResetDraw(qpos, mocap_pos, mocap_quat, np.zeros(count, int))

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    plate, goal = self._plate_xy(state), self._goal_xy(state)
    inside = self._inside(tool, plate)[:, None]
    above = (tool[:, 2] > CLEAR)[:, None]
    off = geometry.norm(tool[:, :2] - plate)
    stay_up = geometry.funnel(off, aligned=ALIGNED, wide=FUNNEL)
    funnel = DRAG_HEIGHT + (HOVER_HEIGHT - DRAG_HEIGHT) * stay_up

    rise = geometry.up(tool[:, :2], HOVER_HEIGHT)
    onto_plate = jnp.where(
      above | (stay_up < 1)[:, None], geometry.up(plate, funnel), rise
    )
    to_object = jnp.where(inside, geometry.up(plate, DRAG_HEIGHT), onto_plate)
    # Full speed from halfway down: the tip's height is what a policy knows least.
    depth = (2 * (LOW - tool[:, 2]) / (LOW - DRAG_HEIGHT)).clip(0.0, 1.0)
    drag = goal - plate
    reach = depth * LOOKAHEAD / jnp.maximum(geometry.norm(drag), LOOKAHEAD)
    drag = drag * reach[:, None]
    over_goal = jnp.where(above, geometry.up(goal, HOVER_HEIGHT), rise)
    to_goal = jnp.where(inside, geometry.up(tool[:, :2] + drag, DRAG_HEIGHT), over_goal)
    positions = self.with_neutral(to_object, to_goal)
    rotations = jnp.broadcast_to(self._neutral_mat, (*positions.shape, 3))
    return positions, rotations, jnp.ones(positions.shape[:2])

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """The plate's center is within 3 cm of the goal's, flat on the table, at rest."""
    del kinematics
    distance = geometry.norm(self._plate_xy(state) - self._goal_xy(state))
    twist = state.qvel[:, self._plate_dof : self._plate_dof + 6]
    on_table = state.qpos[:, self._plate + 2] < 0.01
    axis = geometry.axis(state.qpos[:, self._plate + 3 : self._plate + 7], 2)
    lies = on_table & (axis[:, 2] > FLAT)
    return (distance < GOAL_TOLERANCE) & geometry.is_at_rest(twist) & lies

  def objects(self, state: PhysicsState) -> Array:
    """f32[worlds, 6]: xyz of plate and goal, m."""
    plate = state.qpos[:, self._plate : self._plate + 3]
    return jnp.concatenate([plate, state.mocap_pos[:, self._goal]], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Reach into the plate, then drag."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    inside = self._inside(tool, self._plate_xy(state))[:, None]
    return jnp.where(inside, primitives[:, 1], primitives[:, 0])

  def _plate_xy(self, state: PhysicsState) -> Array:
    return state.qpos[:, self._plate : self._plate + 2]

  def _goal_xy(self, state: PhysicsState) -> Array:
    return state.mocap_pos[:, self._goal, :2]

  def _inside(self, tool: Array, plate: Array) -> Array:
    return (tool[:, 2] < CAPTURE) & (geometry.norm(tool[:, :2] - plate) < INSIDE)
