"""The player: one world, stepped instant by instant, without any display."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax.agents.explanation import Explanation
from apnpql_jax.envs.cameras import camera_renderer
from apnpql_jax.envs.state import EnvState
from apnpql_jax.primitives import tracking
from apnpql_jax.sim import arm
from apnpql_jax.training.diagnose import expert_stage
from apnpql_jax.training.evaluate import check_count
from apnpql_jax.types import ARM_DOF, NUM_PRIMITIVES, Array
from apnpql_jax.viewing.actors import Actor
from apnpql_jax.viewing.frame import Frame, ToolPath

POINTS = 12
"""Points on the path of a primitive."""


class Player:
  """Player of held-out episodes of an actor, in one world."""

  def __init__(
    self, actor: Actor, *, seed: int = 0, wide: tuple[int, int] | None = None
  ):
    """Prepares the world; the first ``step`` begins an episode.

    Args:
      actor: The actor.
      seed: Random seed of the episodes and actions.
      wide: Height and width of the image of the camera ``wide``; not drawn if None.

    Raises:
      ConfigError: The seed is invalid.
    """
    check_count(1, seed)
    self.actor, env = actor, actor.env
    sizes = {"global": env.config.global_size, "wrist": env.config.wrist_size}
    sizes |= {"wide": wide} if wide else {}
    self._cameras = {
      name: camera_renderer(env.config, env.task.scene, name, size)
      for name, size in sizes.items()
    }
    self._chain = arm.make_chain(env.task.scene)
    self._key, self._episode = jax.random.key(seed), 0
    order = np.random.default_rng(seed).permutation(env.held_out)
    self._rows, self._state, self._last = env.bank_split + order, None, True
    self._see = jax.jit(self._see_world)

  def begin(self) -> Frame:
    """Begins an episode, from the next held-out reset state."""
    row = self._rows[self._episode % len(self._rows)]
    self._episode += 1
    return self._observe(self.actor.env.reset(jnp.asarray([row], jnp.int32)))

  def step(self) -> Frame:
    """Executes the action of the last frame, or begins an episode after the last."""
    if self._state is None or self._last:
      return self.begin()
    self._key, key = jax.random.split(self._key)
    return self._observe(self.actor.env.step(self._state, self._action, key))

  def episode(self) -> Iterator[Frame]:
    """Begins an episode and yields its frames until it has ended."""
    frame = self.begin()
    yield frame
    while not frame.last:
      frame = self.step()
      yield frame

  def _observe(self, state: EnvState) -> Frame:
    self._key, key = jax.random.split(self._key)
    self._action, seen, explanation = self._see(self.actor.params, state, key)
    seen = jax.tree.map(lambda x: np.asarray(x)[0], seen)
    self._state, elapsed = state, seen.pop("elapsed")
    # A world that became non-finite has been reset; its episode is over.
    faults, last = seen.pop("faults"), seen.pop("last")
    self._last = bool(last or faults)
    period_s = self.actor.env.config.control_period_s
    return Frame(
      episode=self._episode,
      time_s=float(elapsed) * period_s,
      period_s=period_s,
      checkpoint=self.actor.step,
      last=self._last,
      tool_paths=tuple(map(ToolPath, *seen.pop("tool_paths"))),
      explanation=jax.device_get(explanation),
      **seen,
    )

  def _see_world(
    self, params: Any, state: EnvState, key: PRNGKeyArray
  ) -> tuple[Array, dict[str, Any], Explanation | None]:
    """Returns the action, arrays [1, ...] for a frame by name, and the explanation."""
    env = self.actor.env
    decision = self.actor.decide(params, state, key)
    seen = {
      "action": decision.action,
      "tool_paths": self._tool_paths(state, decision.primitives),
      "stage": expert_stage(env, state),
      "images": {name: self._image(name, state) for name in self._cameras},
      "poses": env.poses(state.physics),
      "elapsed": state.elapsed,
      "solved": state.timestep.terminated,
      "last": state.timestep.last,
      "faults": state.faults,
    }
    explanation = decision.explanation and decision.explanation.at(0)
    return decision.action, seen, explanation

  def _image(self, name: str, state: EnvState) -> Array:
    """Returns the image u8[1, H, W, 3] of a camera: the observed one, if any."""
    observed = getattr(state.timestep.observation, f"{name}_image", None)
    if observed is not None:
      return observed
    return self.actor.env.view(self._cameras[name], state.physics)

  def _tool_paths(
    self, state: EnvState, primitives: Array
  ) -> tuple[Array, Array, Array]:
    """Returns positions f32[worlds, 3, POINTS, 3], last rotations, and closing."""
    scene, physics = self.actor.env.task.scene, state.physics
    q = physics.qpos[:, scene.arm_qpos][:, None]
    velocity = primitives[..., :ARM_DOF].clip(-1.0, 1.0)
    way = tracking.destination(velocity, q) - q
    share = jnp.linspace(0.0, 1.0, POINTS)[:, None]
    joints = (q[:, :, None] + share * way[:, :, None]).reshape(len(q), -1, ARM_DOF)
    chain = arm.with_base(self._chain, scene, physics.fields)
    pos, mat, _ = arm.forward(chain, joints)
    shape = (len(q), NUM_PRIMITIVES, POINTS)
    mat = mat.reshape(*shape, 3, 3)[:, :, -1]
    return pos.reshape(*shape, 3), mat, primitives[..., ARM_DOF]
