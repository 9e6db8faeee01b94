"""Stacking box: put the yellow box on the blue one and let go.

Primitives; following any one of them never knocks a box over:

- object: go above the yellow box, align the fingers with its faces and, through a
  funnel, go down until it is between the open pads; stay there.
- goal: with the box in hand, lift it over the blue one and, through a funnel, down
  onto it, without turning it; with empty hands, go above the blue box.
- neutral: the configuration of the keyframe.

A low tool away from the boxes rises first; fingers closed on nothing do not descend.
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

WORKSPACE = ((0.38, 0.56), (-0.22, 0.22))  # m; x and y within a vertical tool's reach
MAX_YAW = 0.25  # rad; largest yaw of a box
MIN_DISTANCE = 0.13  # m; open fingers (107 mm) around one box clear the other
SIDE = 0.05  # m; edge of a box
HOVER = 0.07  # m; height over the grasp at which the open finger tips clear the box
TRAVEL = 0.14  # m; tool height at which closed fingers clear everything
LIFT = 0.05  # m; clearance of the carried box over the blue one
STACKED_OFF = 0.02  # m; largest offset at success: under half a side, so it stands
STACKED_HEIGHT = 0.005  # m; tolerance of the height difference, which is one side
CLEAR = 0.05  # m; the gripper has let go when the tool is this far from the box


@register_task
class StackBox(TableTask):
  """The task of this module; see ``tasks.task.Task``."""

  name = "stack_box"

  def __init__(self):
    super().__init__()
    self._yellow = FreeBody(*self.scene.free_joint("yellow"))
    self._blue = FreeBody(*self.scene.free_joint("blue"))
    # Four millimeters above the center, for room between fingers and table.
    self._hand = Pinch(
      self.scene, self.neutral_mat, width=SIDE, hover=HOVER, travel=TRAVEL, above=0.004
    )

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    spots = draw_pair(rng, count, WORKSPACE, MIN_DISTANCE)
    qpos = self.draw_qpos(rng, count)
    for box, spot in zip((self._yellow, self._blue), spots, strict=True):
      box.place(qpos, spot, yaw_quat(rng.uniform(-MAX_YAW, MAX_YAW, count)))
    return self.reset_draw(qpos)

  def tool_targets(self, state: PhysicsState, kinematics: Kinematics) -> ToolTargets:
    """See ``Task.tool_targets``."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    yellow, blue = self._yellow.pos(state), self._blue.pos(state)
    yaw = _face_heading(state, self._yellow)
    twist = self._hand.twist(kinematics, yaw, np.pi / 2)
    held = self._hand.holds(state, kinematics, yellow)
    to_object = self._hand.approach(state, kinematics, yellow, twist)

    # Goal: move the tool by the remaining way of the yellow box, high until it is over.
    shift = blue - yellow
    off = geometry.norm(shift[:, :2])
    over = geometry.funnel(off, aligned=ALIGNED / 2, wide=FUNNEL)
    climb = SIDE + 0.001 + LIFT * over
    onto = tool + shift + geometry.at_height(0 * shift[:, :2], climb)
    to_goal = jnp.where(held[:, None], onto, self._hand.go_above(kinematics, blue))

    positions = self.with_neutral(to_object, to_goal)
    turns = jnp.stack([yaw, yaw * held, 0 * yaw], 1)
    around = self._hand.around(kinematics, yellow, twist)
    close = grip(around=around, held=held, done=self._placed(state))
    return positions, geometry.rotation_z(turns) @ self.neutral_mat, close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Checks that yellow stands on blue, both at rest and released by the gripper."""
    stacked = self._stacked(state, STACKED_OFF)
    on_table = self._blue.pos(state)[:, 2] < 0.6 * SIDE
    at_rest = self._yellow.is_at_rest(state) & self._blue.is_at_rest(state)
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    away = geometry.norm(tool - self._yellow.pos(state)) > CLEAR
    return stacked & on_table & at_rest & away

  def objects(self, state: PhysicsState) -> Array:
    """Returns the center of each box and a point beyond its face nearest to +x."""
    parts = []
    for box in (self._yellow, self._blue):
      angle, center = _face_heading(state, box), box.pos(state)
      heading = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], -1)
      parts += [center, center + geometry.POINTER * heading]
    return jnp.concatenate(parts, -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Picks the yellow box and places it on the blue one."""
    held = self._hand.holds(state, kinematics, self._yellow.pos(state))
    done, is_open = self._placed(state), self._hand.is_open(state)
    return pick_and_place(primitives, held=held, done=done, is_open=is_open)

  def _placed(self, state: PhysicsState) -> Array:
    """Checks that the yellow box is placed well enough to be released."""
    return self._stacked(state, STACKED_OFF / 2)

  def _stacked(self, state: PhysicsState, off: float) -> Array:
    """Checks that yellow is on blue, within ``off`` (m), bool[worlds]."""
    shift = self._yellow.pos(state) - self._blue.pos(state)
    level = jnp.abs(shift[:, 2] - SIDE) < STACKED_HEIGHT
    return level & (geometry.norm(shift[:, :2]) < off)


def _face_heading(state: PhysicsState, box: FreeBody) -> Array:
  """Returns the heading of the box's face nearest to the world's x axis, rad."""
  # The box looks the same after a quarter turn.
  return geometry.fold(geometry.level_heading(box.quat(state)), np.pi / 2)
