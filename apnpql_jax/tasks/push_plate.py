"""Pushing plate: drag a rimmed plate onto the goal mark from inside its rim.

Primitives; following any one of them never knocks the plate over:

- object: go above the plate and, through a funnel, down to its floor until the closed
  finger tips are inside the rim; from inside, move to the plate's center.
- goal: from inside the rim, move by the plate's remaining way to the goal, which drags
  it along; slower where the tool is less deep. From elsewhere, go above the goal.
- neutral: the configuration of the keyframe.

The fingers stay closed. A tool that is low but outside the plate rises first. While
dragging, the target is a waypoint at most ``LOOKAHEAD`` ahead, because a straight line
in joint space deviates from one on the table by L^2 / 8r (1.2 mm for 0.07 m at 0.5 m).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.table_task import FreeBody, TableTask, draw_pair, yaw_quat
from apnpql_jax.tasks.task import ResetDraw, ToolTargets, register_task
from apnpql_jax.types import Array

WORKSPACE = ((0.36, 0.58), (-0.24, 0.24))  # m; x and y within a vertical tool's reach
MIN_DISTANCE = 0.12  # m between plate and goal: four times the goal's tolerance
GOAL_TOLERANCE = 0.03  # m; the mark's radius minus the plate's: inside is solved
FLAT = 0.97  # cosine of 14 degrees; height alone does not exclude a plate upside down
HOVER_HEIGHT = 0.08  # m; tool height at which the finger tips clear the rim (34 mm)
CLEAR = 0.05  # m; above this the tool may travel without touching the rim
DRAG_HEIGHT = 0.012  # m; 6 mm above the plate's floor, the tips' sides against the rim
LOW = 0.03  # m; the tips drag below this, behind the rim (center line at 22 mm)
INSIDE = 0.083  # m; radius of the rim's center line
# m; below this within the rim, both primitives lead down to drag. Well above the drag
# height, because a policy that misjudges where they reverse would lift off the plate.
CAPTURE = 0.06
ALIGNED = 0.02  # m; the tool descends this close to the axis, 33 mm from the rim
FUNNEL = 0.055  # m; the height falls linearly from here to ``ALIGNED``
LOOKAHEAD = 0.07  # m; longest step of a dragging tool's waypoint


@register_task
class PushPlate(TableTask):
  """The task of this module; see ``tasks.task.Task``."""

  name = "push_plate"

  def __init__(self):
    super().__init__()
    self._plate = FreeBody(*self.scene.free_joint("plate"))
    self._goal = self.scene.mocap("goal")

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    plate, goal = draw_pair(rng, count, WORKSPACE, MIN_DISTANCE)
    qpos = self.draw_qpos(rng, count)
    self._plate.place(qpos, plate, yaw_quat(rng.uniform(-np.pi, np.pi, count)))
    return self.reset_draw(qpos, (self._goal, goal, 0.0))

  def tool_targets(self, state: PhysicsState, kinematics: Kinematics) -> ToolTargets:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    plate, goal = self._plate.pos(state)[:, :2], state.mocap_pos[:, self._goal, :2]
    inside = self._inside(state, kinematics)[:, None]
    above = (tool[:, 2] > CLEAR)[:, None]
    rise = geometry.at_height(tool[:, :2], HOVER_HEIGHT)

    # Object: down through the funnel; inside the rim, to the center.
    off = geometry.norm(tool[:, :2] - plate)
    stay_up = geometry.funnel(off, aligned=ALIGNED, wide=FUNNEL)
    funnel = DRAG_HEIGHT + (HOVER_HEIGHT - DRAG_HEIGHT) * stay_up
    may_descend = above | (stay_up < 1)[:, None]
    onto_plate = jnp.where(may_descend, geometry.at_height(plate, funnel), rise)
    to_object = jnp.where(inside, geometry.at_height(plate, DRAG_HEIGHT), onto_plate)

    # Goal: drag the plate. A policy judges the height of the tips worst of all, so that
    # half of the depth already gives full speed.
    depth = (2 * (LOW - tool[:, 2]) / (LOW - DRAG_HEIGHT)).clip(0.0, 1.0)
    drag = goal - plate
    reach = depth * LOOKAHEAD / jnp.maximum(geometry.norm(drag), LOOKAHEAD)
    dragged = geometry.at_height(tool[:, :2] + drag * reach[:, None], DRAG_HEIGHT)
    over_goal = jnp.where(above, geometry.at_height(goal, HOVER_HEIGHT), rise)
    to_goal = jnp.where(inside, dragged, over_goal)

    positions = self.with_neutral(to_object, to_goal)
    rotations = jnp.broadcast_to(self.neutral_mat, (*positions.shape, 3))
    return positions, rotations, jnp.ones(positions.shape[:2])

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that the plate is within 3 cm of the goal, flat on the table, at rest."""
    plate, goal = self._plate.pos(state), state.mocap_pos[:, self._goal]
    near = geometry.norm(plate[:, :2] - goal[:, :2]) < GOAL_TOLERANCE
    flat = geometry.axis(self._plate.quat(state), 2)[:, 2] > FLAT
    return near & self._plate.is_at_rest(state) & (plate[:, 2] < 0.01) & flat

  def objects(self, state: PhysicsState) -> Array:
    """Returns the positions of plate and goal."""
    return jnp.concatenate([self._plate.pos(state), state.mocap_pos[:, self._goal]], -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Reaches into the plate, then drags."""
    inside = self._inside(state, kinematics)[:, None]
    return jnp.where(inside, primitives[:, 1], primitives[:, 0])

  def _inside(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that the tool is low and within the rim, bool[worlds]."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    off = geometry.norm(tool[:, :2] - self._plate.pos(state)[:, :2])
    return (tool[:, 2] < CAPTURE) & (off < INSIDE)
