"""Rollouts of policies: loops over time, batched over worlds, into the replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.learner import Agent
from apnpql_jax.agents.networks import Params
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.types import ACTION_DIM, ARM_DOF, Array, Slot

WorldPolicy = Callable[[EnvState, PRNGKeyArray], tuple[Array, Array]]
"""(worlds, key) -> actions f32[worlds, 7], log densities f32[worlds]."""

FILMED = 4
"""Number of episodes, the first of a batch, whose states are kept for a video."""

_LEAST_NOISE = 1e-6
"""Standard deviation in rad/s for zero noise; denser than any policy."""


def agent_policy(agent: Agent, params: Params, *, acting: str) -> WorldPolicy:
  """Returns the learned policy, which depends on observations only.

  ``acting`` is a rule of ``agents/acting.py``.
  """

  def policy(state: EnvState, key: PRNGKeyArray) -> tuple[Array, Array]:
    action, info = agent.act(params, state.observation, key, acting=acting)
    return action, info["log_prob"]

  return policy


def expert_policy(env: Env, *, noise: float) -> WorldPolicy:
  """Returns the task's scripted expert with Gaussian noise on its joint velocities.

  ``noise`` is its standard deviation in rad/s.
  """

  def policy(state: EnvState, key: PRNGKeyArray) -> tuple[Array, Array]:
    action = env.expert_action(state)
    mean = action[..., :ARM_DOF]
    velocity = (mean + noise * jax.random.normal(key, mean.shape)).clip(-1.0, 1.0)
    density = jax.scipy.stats.norm.logpdf(
      velocity, mean, jnp.maximum(noise, _LEAST_NOISE)
    )
    action = jnp.concatenate([velocity, action[..., ARM_DOF:]], axis=-1)
    return action, jnp.sum(density, axis=-1)

  return policy


def rollout(
  env: Env, policy: WorldPolicy, state: EnvState, key: PRNGKeyArray, *, length: int
) -> tuple[EnvState, Slot]:
  """Plays ``length`` control periods in every world, episode after episode.

  Returns:
    The worlds afterwards, and the slots with leaves [length, worlds, ...].
  """

  def period(state: EnvState, key: PRNGKeyArray) -> tuple[EnvState, Slot]:
    policy_key, env_key = jax.random.split(key)
    action, log_prob = policy(state, policy_key)
    slot = Slot(timestep=state.timestep, action=action, log_prob=log_prob)
    return env.step(state, action, env_key), slot

  return jax.lax.scan(period, state, jax.random.split(key, length))


def example_slot(worlds: EnvState) -> Slot:
  """Returns the shapes and dtypes of a replay slot of one world."""
  action: Any = jax.ShapeDtypeStruct((ACTION_DIM,), jnp.float32)
  log_prob: Any = jax.ShapeDtypeStruct((), jnp.float32)
  timestep = jax.tree.map(
    lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), worlds.timestep
  )
  return Slot(timestep=timestep, action=action, log_prob=log_prob)


def add_chunk(ring: Replay, before: EnvState, after: EnvState, chunk: Slot) -> Replay:
  """Adds a chunk [time, worlds, ...] to a replay.

  If a world became non-finite, its chunk and the episode before are never sampled.
  """
  steps = before.elapsed + chunk.action.shape[0]
  broken = after.faults > before.faults
  return replay.exclude(replay.add(ring, chunk), jnp.where(broken, steps, 0))


class Episodes(struct.PyTreeNode):
  """One episode per world."""

  success: Array  # bool[worlds]
  length: Array  # i32[worlds]: control periods until success or time-out
  states: PhysicsState  # [time, <= FILMED, ...]: instants 0 to ``length``


Player = Callable[[Any, Array, PRNGKeyArray], Episodes]
"""(parameters of the policy, bank rows i32[worlds], key) -> episodes."""


_Carry = tuple[Arrival, Episodes, Array, Array | int, PRNGKeyArray]
"""Worlds, their episodes so far, which still run, time, key."""


def make_player(env: Env, make_policy: Callable[[Any], WorldPolicy]) -> Player:
  """Returns a jitted function that plays one episode per row until all are over.

  A world that becomes non-finite counts as failed.
  """

  @jax.jit
  def play(params: Any, rows: Array, key: PRNGKeyArray) -> Episodes:
    policy = make_policy(params)

    def step(carry: _Carry) -> _Carry:
      now, played, running, time, key = carry
      state = env.observe(now)
      running &= state.faults == 0
      played = Episodes(
        success=played.success | running & state.timestep.terminated,
        length=jnp.where(running, state.elapsed, played.length),
        states=jax.tree.map(
          lambda kept, x: jax.lax.dynamic_update_index_in_dim(
            kept, x[: kept.shape[1]], time, axis=0
          ),
          played.states,
          state.physics,
        ),
      )
      key, policy_key, env_key = jax.random.split(key, 3)
      now = env.advance(state, policy(state, policy_key)[0], env_key)
      return now, played, running & ~state.timestep.last, time + 1, key

    now, worlds = env.begin(rows), rows.shape[0]
    shape = (env.config.episode_steps + 1, min(worlds, FILMED))
    nothing = Episodes(
      success=jnp.zeros(worlds, bool),
      length=jnp.zeros(worlds, jnp.int32),
      states=jax.tree.map(
        lambda x: jnp.zeros(shape + x.shape[1:], x.dtype), now.physics
      ),
    )
    start = (now, nothing, jnp.ones(worlds, bool), 0, key)
    return jax.lax.while_loop(lambda carry: carry[2].any(), step, start)[1]

  return play
