"""Touching a ball: the fingertips reach a ball that hangs in the air."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from apnpql_jax import load_preset
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.table_task import TableTask
from apnpql_jax.tasks.task import ResetDraw, register_task
from apnpql_jax.types import Array

LOW, HIGH = (0.36, -0.24, 0.10), (0.56, 0.24, 0.25)
"""Corners of the box in which the ball hangs, m."""

TOUCH = 0.02
"""Distance to the center of the ball that counts as a touch, m."""


@register_task
class TouchBall(TableTask):
  """The task; see the module's docstring and ``tasks.task.Task``."""

  name = "touch_ball"

  def __init__(self):
    super().__init__()
    self._ball = self.scene.mocap("ball")

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """See ``Task.sample_resets``."""
    pos, quat = np.zeros((count, 1, 3)), np.zeros((count, 1, 4))
    pos[:, self._ball] = rng.uniform(LOW, HIGH, (count, 3))
    quat[..., 0] = 1
    return ResetDraw(self.draw_qpos(rng, count), pos, quat, np.zeros(count, int))

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """Returns a point 8 cm above the ball, the ball itself, and closed fingers."""
    ball = state.mocap_pos[:, self._ball]
    positions = self.with_neutral(ball + jnp.asarray([0.0, 0.0, 0.08]), ball)
    rotations = jnp.broadcast_to(self.neutral_mat, (*positions.shape, 3))
    return positions, rotations, jnp.ones(positions.shape[:2])

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """Returns whether the fingertips are at the ball."""
    tool = kinematics.site_xpos[:, self.scene.tool_site]
    return geometry.norm(tool - state.mocap_pos[:, self._ball]) < TOUCH

  def objects(self, state: PhysicsState) -> Array:
    """Returns the position of the ball, f32[worlds, 3], m."""
    return state.mocap_pos[:, self._ball]

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """Moves straight to the ball."""
    return primitives[:, 1]


_PUSH = load_preset("push_plate")
CONFIG = dataclasses.replace(
  _PUSH, env=dataclasses.replace(_PUSH.env, task="touch_ball")
)
"""Preset: the ball from pixels, with the agent of push_plate."""
