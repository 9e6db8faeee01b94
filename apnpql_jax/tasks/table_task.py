"""Base of the tasks at the robot's table: scene, neutral state, drawing of resets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import inspect
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float
import mujoco
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim import arm
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.tasks import geometry
from apnpql_jax.tasks.task import ResetDraw
from apnpql_jax.types import Array


class FreeBody(NamedTuple):
  """A body with a free joint: its addresses (``Scene.free_joint``) in qpos and qvel."""

  qpos: int
  qvel: int

  def pos(self, state: PhysicsState) -> Float[Array, "worlds 3"]:
    """Returns the position, m."""
    return state.qpos[:, self.qpos : self.qpos + 3]

  def quat(self, state: PhysicsState) -> Float[Array, "worlds 4"]:
    """Returns the orientation, wxyz."""
    return state.qpos[:, self.qpos + 3 : self.qpos + 7]

  def is_at_rest(self, state: PhysicsState) -> Bool[Array, " worlds"]:
    """Checks that the body neither moves nor turns."""
    return geometry.is_at_rest(state.qvel[:, self.qvel : self.qvel + 6])

  def place(self, qpos: np.ndarray, xy: np.ndarray, quat: np.ndarray) -> None:
    """Writes horizontal positions f64[n, 2] and orientations f64[n, 4] into qpos."""
    qpos[:, self.qpos : self.qpos + 2] = xy
    qpos[:, self.qpos + 3 : self.qpos + 7] = quat


class TableTask:
  """Base of the tasks.

  The scene is ``<name>.xml`` next to the file of the class, or else in ``mjcf/``. It
  has a keyframe ``neutral``, where the rotation of the tool is ``neutral_mat``.
  """

  name: str
  arm_noise = 0.15  # rad; uniform spread of the initial joint angles around neutral

  def __init__(self, variants: Sequence[Callable[[mujoco.MjSpec], None]] = ()):
    self.scene = load_scene(
      self._mjcf(), cameras=("global", "wrist", "wide"), variants=variants
    )
    self._neutral_qpos = self.scene.keyframe("neutral")
    neutral = jnp.asarray(self._neutral_qpos[self.scene.arm_qpos], jnp.float32)
    chain = arm.make_chain(self.scene)
    self._neutral_pos, self.neutral_mat, _ = arm.forward(chain, neutral)

  def _mjcf(self) -> Path:
    """Returns the path of the scene, or raises ``ConfigError`` if there is none."""
    own = Path(inspect.getfile(type(self))).with_name(f"{self.name}.xml")
    if own.is_file():
      return own
    try:
      return mjcf_path(self.name)
    except ConfigError:
      raise ConfigError(f"task {self.name!r} has no scene: {own} is missing") from None

  def draw_qpos(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draws neutral states with noise on the arm, f64[count, nq]."""
    qpos = np.tile(self._neutral_qpos, (count, 1))
    spread = rng.uniform(-self.arm_noise, self.arm_noise, (count, 6))
    qpos[:, self.scene.arm_qpos] += spread
    return qpos

  def reset_draw(
    self,
    qpos: np.ndarray,
    *mocap: tuple[int, np.ndarray, np.ndarray | float],
    variant: np.ndarray | int = 0,
  ) -> ResetDraw:
    """Completes qpos f64[n, nq] by index, xy and yaw of mocap bodies, and variants."""
    pos = np.zeros((len(qpos), self.scene.model.nmocap, 3))
    quat = np.zeros((*pos.shape[:2], 4))
    for index, xy, yaw in mocap:
      pos[:, index, :2], quat[:, index] = xy, yaw_quat(np.broadcast_to(yaw, len(qpos)))
    return ResetDraw(qpos, pos, quat, np.broadcast_to(variant, len(qpos)).astype(int))

  def with_neutral(
    self, to_object: Float[Array, "worlds 3"], to_goal: Float[Array, "worlds 3"]
  ) -> Float[Array, "worlds 3 3"]:
    """Returns the tool positions of all three primitives, m."""
    neutral = jnp.broadcast_to(self._neutral_pos, to_goal.shape)
    return jnp.stack([to_object, to_goal, neutral], 1)


def draw_pair(
  rng: np.random.Generator,
  count: int,
  ranges: tuple[tuple[float, float], tuple[float, float]],
  min_distance: float,
  to_xy: Callable[[np.ndarray], np.ndarray] = lambda spots: spots,
) -> np.ndarray:
  """Draws f64[2, count, 2] (m), pairs of spots at least ``min_distance`` apart.

  They are uniform in ``ranges`` of coordinates, which ``to_xy`` converts to x and y.
  """
  low, high = np.array(ranges).T
  pair = to_xy(rng.uniform(low, high, (2, count, 2)))
  while (near := np.linalg.norm(pair[0] - pair[1], axis=-1) < min_distance).any():
    pair[:, near] = to_xy(rng.uniform(low, high, (2, int(near.sum()), 2)))
  return pair


def yaw_quat(yaw: np.ndarray) -> np.ndarray:
  """Returns quaternions f64[n, 4] of turns f64[n] (rad) about the vertical."""
  zero = np.zeros_like(yaw)
  return np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], -1)
