"""What all tasks at the robot's table share: the scene and its neutral state."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.sim import arm
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.types import Array


class TableTask:
  """Base of the tasks; the scene is ``mjcf/<name>.xml`` with a keyframe ``neutral``."""

  name: str

  arm_noise = 0.15
  """rad; uniform spread of the initial joint angles around the neutral ones."""

  def __init__(self, variants: Sequence[Callable[[mujoco.MjSpec], None]] = ()):
    """Compiles the scene.

    Args:
      variants: see ``sim.scene.load_scene``.
    """
    self.scene = load_scene(
      mjcf_path(self.name), cameras=("global", "wrist", "wide"), variants=variants
    )
    self._neutral_qpos = self.scene.keyframe("neutral")
    neutral = jnp.asarray(self._neutral_qpos[self.scene.arm_qpos], jnp.float32)
    chain = arm.make_chain(self.scene)
    self._neutral_pos, self._neutral_mat, _ = arm.forward(chain, neutral)

  def draw_qpos(self, rng: np.random.Generator, count: int) -> np.ndarray:
    """f64[count, nq]: neutral states with the arm a little away from it."""
    qpos = np.tile(self._neutral_qpos, (count, 1))
    spread = rng.uniform(-self.arm_noise, self.arm_noise, (count, 6))
    qpos[:, self.scene.arm_qpos] += spread
    return qpos

  def with_neutral(self, to_object: Array, to_goal: Array) -> Array:
    """f32[worlds, 3, 3]: tool positions of the three primitives."""
    neutral = jnp.broadcast_to(self._neutral_pos, to_goal.shape)
    return jnp.stack([to_object, to_goal, neutral], 1)
