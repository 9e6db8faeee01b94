"""Rollouts on the host, whose physics and images may come from outside of JAX.

The loop over time is in Python. With the engine and the cameras of the environment it
plays the same episodes as ``training.rollout.make_player``.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.training.diagnose import expert_stage
from apnpql_jax.types import Array, Observation

Draw = Callable[
  [PhysicsState, np.ndarray, np.ndarray, int | np.ndarray], tuple[Array, Array]
]
"""(worlds, bank rows, worlds that still run, instants) -> images u8[worlds, H, W, 3] of
the global and the wrist camera."""

Act = Callable[[EnvState, Observation, PRNGKeyArray], Array]
"""(worlds, observation, key) -> actions f32[worlds, 7], as of ``Env.step``."""

Advance = Callable[[EnvState, Array, np.ndarray], Arrival]
"""(worlds, actions f32[worlds, 7], worlds that still run) -> a period later."""


@dataclasses.dataclass(frozen=True)
class EpisodeBatch:
  """A batch of episodes, one per world."""

  success: np.ndarray  # bool[worlds]
  length: np.ndarray  # i32[worlds], control periods
  stages: list[np.ndarray]  # i32[length] each: stage at every instant but the last
  rows: np.ndarray  # i32[worlds] of the bank
  start: PhysicsState
  """The worlds at the first instant."""
  qpos: np.ndarray
  """Their configurations at every instant, f32[time, worlds, nq]."""

  def without_last(self, count: int) -> EpisodeBatch:
    """Returns all but the last ``count`` episodes; ``start`` and ``qpos`` are kept."""
    kept = len(self.success) - count
    names = "success", "length", "stages", "rows"
    return dataclasses.replace(self, **{x: getattr(self, x)[:kept] for x in names})


def play(
  env: Env,
  act: Act,
  rows: Array,
  key: PRNGKeyArray,
  *,
  draw: Draw | None = None,
  lstm_instants: int = 0,
  advance: Advance | None = None,
) -> EpisodeBatch:
  """Plays one episode per row of the bank; a world that breaks counts as failed.

  Args:
    env: The worlds.
    act: The policy.
    rows: Rows of the bank, i32[worlds].
    key: Key of actions and resets.
    draw: Draws the images; those of ``env``, if any, if None.
    lstm_instants: L of ``EnvState.recent``, with ``draw``.
    advance: Runs the physics; that of ``env`` if None.
  """
  count = len(rows)
  running, success = np.ones(count, bool), np.zeros(count, bool)
  length, stages = np.zeros(count, np.int32), []
  state, recent, qpos = env.reset(rows), None, []
  start = state.physics
  for time in range(env.config.episode_steps + 1):
    running = running & (np.asarray(state.faults) == 0)
    success |= running & np.asarray(state.timestep.terminated)
    length = np.where(running, np.asarray(state.elapsed), length)
    running = running & ~np.asarray(state.timestep.last)
    qpos.append(np.asarray(state.physics.qpos))
    stages.append(np.where(running, np.asarray(_stage(env, state)), -1))
    if not running.any():
      break
    seen = state.observation
    if draw is not None:
      images = draw(state.physics, np.asarray(rows), running, time)
      seen = with_images(state.timestep.observation, images)
      if lstm_instants:
        recent = _pushed(recent, seen, lstm_instants)
        seen = recent
    key, policy_key, env_key = jax.random.split(key, 3)
    action = act(state, seen, policy_key)
    if advance is None:
      state = env.step(state, action, env_key)
    else:
      state = env.observe(advance(state, action, running))
  active = np.stack(stages)
  kept = [x[x >= 0] for x in active.T]
  return EpisodeBatch(success, length, kept, np.asarray(rows), start, np.stack(qpos))


@functools.partial(jax.jit, static_argnums=0)
def _stage(env: Env, state: EnvState) -> Array:
  """Returns ``expert_stage``, traced once for all batches of an environment."""
  return expert_stage(env, state)


def with_images(observation: Observation, images: tuple[Array, Array]) -> Observation:
  """Returns the observation with images in place of the points on the objects."""
  overview, wrist = images
  return observation.replace(objects=None, global_image=overview, wrist_image=wrist)


def _pushed(recent: Any, new: Any, lstm_instants: int) -> Any:
  """Returns the last observations [worlds, L, ...]; the first one is repeated."""
  if recent is None:
    return jax.tree.map(lambda x: jnp.repeat(x[:, None], lstm_instants, axis=1), new)
  return jax.tree.map(
    lambda old, x: jnp.concatenate([old[:, 1:], x[:, None]], axis=1), recent, new
  )
