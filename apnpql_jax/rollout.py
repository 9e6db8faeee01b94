"""Policies at work in the worlds: scans over time, batched over worlds."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import Agent
from apnpql_jax.agents.networks import Params
from apnpql_jax.env import Env, EnvState
from apnpql_jax.types import ARM_DOF, Array, Slot

Policy = Callable[[EnvState, Array], tuple[Array, Array]]
"""(worlds, key) -> actions f32[worlds, 7], their log densities f32[worlds]."""

_LEAST_NOISE = 1e-6
"""Deviation in rad/s that stands for none: its density outweighs any policy's."""


def agent_policy(agent: Agent, params: Params, *, greedy: bool) -> Policy:
  """The learned policy; sees observations only."""

  def policy(state: EnvState, key: Array) -> tuple[Array, Array]:
    action, info = agent.act(params, state.seen, key, greedy)
    return action, info["log_prob"]

  return policy


def expert_policy(env: Env, *, noise: float) -> Policy:
  """The scripted expert with Gaussian noise on its joint velocities.

  Args:
    env: the worlds, whose task knows the expert.
    noise: standard deviation, rad/s.
  """

  def policy(state: EnvState, key: Array) -> tuple[Array, Array]:
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
  env: Env, policy: Policy, state: EnvState, key: Array, *, length: int
) -> tuple[EnvState, Slot]:
  """Plays ``length`` control periods in every world, episode after episode.

  Returns:
    the worlds afterwards, and what was seen and done, leaves [length, worlds, ...].
  """

  def period(state: EnvState, key: Array) -> tuple[EnvState, Slot]:
    policy_key, env_key = jax.random.split(key)
    action, log_prob = policy(state, policy_key)
    slot = Slot(timestep=state.timestep, action=action, log_prob=log_prob)
    return env.step(state, action, env_key), slot

  return jax.lax.scan(period, state, jax.random.split(key, length))
