"""Stacking box: put the yellow box on the blue one and let go.

Primitives, so that following one of them never knocks a box over:

- object: go above the yellow box, turn the fingers to its faces and, through a
  funnel, down until it is between the open pads; stay there.
- goal: with the box in hand, lift it over the blue one and, through a funnel, down
  onto it, without turning it; with empty hands, go above the blue box.
- neutral: the configuration of the keyframe.

A low tool that is not at a box rises first; fingers that are closed on nothing do not
descend.
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

WORKSPACE = ((0.38, 0.56), (-0.22, 0.22))
"""m; x and y ranges of both boxes, within reach of a vertical tool."""

MAX_YAW = 0.25
"""rad; boxes are turned by at most this."""

MIN_DISTANCE = 0.13
"""m between the boxes: the open fingers (107 mm) around one clear the other."""

SIDE = 0.05
"""m; edge of a box."""

HOVER = 0.07
"""m; height over the grasp at which the open finger tips clear the box."""

TRAVEL = 0.14
"""m; tool height at which closed fingers clear everything."""

LIFT = 0.05
"""m; clearance of the carried box over the blue one."""

STACKED_OFF = 0.02
"""m; success needs the centers this close: less than half a side, so it stands."""

STACKED_HEIGHT = 0.005
"""m; tolerance of the height difference of one side."""

CLEAR = 0.05
"""m; the gripper has let go when the tool is this far from the box."""


@register_task
class StackBox(TableTask):
  """See the module's docstring; implements ``tasks.task.Task``."""

  name = "stack_box"

  def __init__(self):
    super().__init__()
    self._yellow, self._yellow_dof = self.scene.free_joint("yellow")
    self._blue, self._blue_dof = self.scene.free_joint("blue")
    # Four millimeters above the center, for room between fingers and table.
    self._hand = Pinch(
      self.scene,
      self._neutral_mat,
      width=SIDE,
      above=0.004,
      hover=HOVER,
      travel=TRAVEL,
    )

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    low, high = np.array(WORKSPACE).T
    yellow, blue = rng.uniform(low, high, (2, count, 2))
    while (near := np.linalg.norm(yellow - blue, axis=-1) < MIN_DISTANCE).any():
      yellow[near], blue[near] = rng.uniform(low, high, (2, int(near.sum()), 2))
    qpos = self.draw_qpos(rng, count)
    for address, spot in ((self._yellow, yellow), (self._blue, blue)):
      half = rng.uniform(-MAX_YAW, MAX_YAW, count) / 2
      qpos[:, address : address + 2] = spot
      qpos[:, address + 3], qpos[:, address + 6] = np.cos(half), np.sin(half)
    no_mocap = np.zeros((count, 0, 3)), np.zeros((count, 0, 4))
    return ResetDraw(qpos, *no_mocap, np.zeros(count, int))

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """See ``Task.tool_targets``."""
    yellow, blue = self._yellow_pos(state), self._blue_pos(state)
    yellow_yaw = self._yaw(state, self._yellow)
    twist = self._hand.twist(kinematics, yellow_yaw, np.pi / 2)
    to_object = self._hand.approach(state, kinematics, yellow, twist)

    shift = blue - yellow
    over = geometry.funnel(
      geometry.norm(shift[:, :2]), aligned=ALIGNED / 2, wide=FUNNEL
    )
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    onto = tool + shift + geometry.up(0 * shift[:, :2], SIDE + 0.001 + LIFT * over)
    held = self._hand.holds(state, kinematics, yellow)
    to_goal = jnp.where(held[:, None], onto, self._hand.above(kinematics, blue))

    positions = self.with_neutral(to_object, to_goal)
    turns = jnp.stack([yellow_yaw, yellow_yaw * held, 0 * yellow_yaw], 1)
    close = grip(
      around=self._hand.around(kinematics, yellow, twist),
      held=held,
      done=self._placed(state),
    )
    return positions, geometry.turn_z(turns) @ self._neutral_mat, close

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Yellow stands on blue, both at rest, and the gripper has let go."""
    yellow, blue = self._yellow_pos(state), self._blue_pos(state)
    stacked = self._stacked(state, STACKED_OFF, STACKED_HEIGHT)
    on_table = blue[:, 2] < 0.6 * SIDE
    at_rest = geometry.is_at_rest(
      state.qvel[:, self._yellow_dof : self._yellow_dof + 6]
    ) & geometry.is_at_rest(state.qvel[:, self._blue_dof : self._blue_dof + 6])
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    return stacked & on_table & at_rest & (geometry.norm(tool - yellow) > CLEAR)

  def objects(self, state: PhysicsState) -> Array:
    """f32[worlds, 12]: of either box the center and a point beyond the face nearest
    to the world's x axis, m: boxes look the same after a quarter turn."""
    parts = []
    for address in (self._yellow, self._blue):
      angle = self._yaw(state, address)
      heading = jnp.stack([jnp.cos(angle), jnp.sin(angle), 0 * angle], -1)
      center = state.qpos[:, address : address + 3]
      parts += [center, center + geometry.POINTER * heading]
    return jnp.concatenate(parts, -1)

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Pick the yellow box, place it on the blue one."""
    return pick_and_place(
      primitives,
      held=self._hand.holds(state, kinematics, self._yellow_pos(state)),
      done=self._placed(state),
      is_open=self._hand.is_open(state),
    )

  def _yellow_pos(self, state: PhysicsState) -> Array:
    return state.qpos[:, self._yellow : self._yellow + 3]

  def _blue_pos(self, state: PhysicsState) -> Array:
    return state.qpos[:, self._blue : self._blue + 3]

  def _yaw(self, state: PhysicsState, address: int) -> Array:
    """Heading of the box's face nearest to the world's x axis."""
    quat = state.qpos[:, address + 3 : address + 7]
    return geometry.fold(geometry.level_heading(quat), np.pi / 2)

  def _placed(self, state: PhysicsState) -> Array:
    """Well enough on the blue box to be let go."""
    return self._stacked(state, STACKED_OFF / 2, STACKED_HEIGHT)

  def _stacked(self, state: PhysicsState, off: float, height: float) -> Array:
    shift = self._yellow_pos(state) - self._blue_pos(state)
    level = jnp.abs(shift[:, 2] - SIDE) < height
    return level & (geometry.norm(shift[:, :2]) < off)
