"""The training iteration: a pure function of the training state."""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.learner import Agent, LearnerState
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.envs.env import Env
from apnpql_jax.training.placement import place
from apnpql_jax.training.rollout import add_chunk, agent_policy, rollout
from apnpql_jax.training.state import SkippedUpdates, TrainState
from apnpql_jax.types import Array, Metrics, Transition

Iteration = Callable[[TrainState], tuple[TrainState, Metrics]]

Sample = Callable[..., Transition]
"""(replay, expert replay, key) -> batch [B, ...] of an update."""


def make_iteration(config: TrainConfig, env: Env, agent: Agent) -> Iteration:
  """Returns the jitted iteration (paper Algorithm 1): rollouts, then gradient steps.

  It donates its argument, so callers must continue with the returned state.
  """
  sample = make_sample(config, agent, env.mesh)

  def iteration(state: TrainState) -> tuple[TrainState, Metrics]:
    key, rollout_key, update_key = jax.random.split(state.key, 3)
    policy = agent_policy(agent, state.learner.target_params, acting="policy")
    worlds, chunk = rollout(
      env, policy, state.env, rollout_key, length=config.rollout_length
    )
    ring = add_chunk(state.replay, state.env, worlds, chunk)
    keys = jax.random.split(update_key, config.updates_per_iteration)
    update = functools.partial(_update, agent, sample, ring, state.expert_replay)
    (learner, faults), (metrics, ok) = jax.lax.scan(
      update, (state.learner, state.faults), keys
    )
    metrics = {name: jnp.mean(x, where=ok) for name, x in metrics.items()}
    metrics |= {
      "rollout/successes": chunk.timestep.terminated.sum(),
      "rollout/timeouts": chunk.timestep.truncated.sum(),
      "rollout/close_share": chunk.action[..., -1].mean(),
      "faults/worlds": (worlds.faults - state.env.faults).sum(),
      "faults/updates": (~ok).sum(),
      "faults/updates_in_a_row": faults.in_a_row,
    }
    steps = config.rollout_length * config.env.worlds
    state = state.replace(
      learner=learner,
      env=worlds,
      replay=ring,
      key=key,
      env_steps=state.env_steps + steps,
      faults=faults,
    )
    return place((state, metrics), env.mesh)

  return jax.jit(iteration, donate_argnums=0)


def compile_iteration(
  config: TrainConfig, env: Env, agent: Agent, example: TrainState
) -> Iteration:
  """Returns ``make_iteration`` compiled for the shapes and placement of ``example``."""
  jitted: Any = make_iteration(config, env, agent)
  return jitted.lower(example).compile()


def _update(
  agent: Agent,
  sample: Sample,
  ring: Replay,
  expert_replay: Replay | None,
  carry: tuple[LearnerState, SkippedUpdates],
  key: PRNGKeyArray,
) -> tuple[tuple[LearnerState, SkippedUpdates], tuple[Metrics, Array]]:
  """Runs one update inside ``scan``; skips and counts it if it is non-finite."""
  learner, faults = carry
  sample_key, learn_key = jax.random.split(key)
  batch = sample(ring, expert_replay, sample_key)
  updated, metrics = agent.update(learner, batch, learn_key)
  # Gradient norms cover all losses and parameters. A non-finite reward in the batch can
  # vanish in the clipping of the projection.
  norms = {k: v for k, v in metrics.items() if k.startswith("grad_norm/")}
  leaves = jax.tree.leaves((batch, norms, updated.nu))
  ok = jnp.stack([jnp.isfinite(x).all() for x in leaves]).all()
  learner = jax.tree.map(functools.partial(jnp.where, ok), updated, learner)
  faults = SkippedUpdates(
    in_a_row=jnp.where(ok, 0, faults.in_a_row + 1),
    key=jnp.where(ok, faults.key, key),
  )
  return (learner, faults), (metrics, ok)


def make_sample(config: TrainConfig, agent: Agent, mesh: Mesh | None = None) -> Sample:
  """Returns a function that draws the batch of an update."""
  draw = functools.partial(
    replay.sample_mixed,
    batch_size=config.replay.batch_size,
    expert_share=config.replay.expert_share,
    n_step=config.agent.n_step,
    gamma=config.agent.gamma,
    windows=agent.policy_evaluation.windows,
    lstm_instants=config.agent.lstm_instants,
  )
  if mesh is None:
    return draw

  def sample(*args: Any) -> Transition:
    # Replicate the batch before splitting it: XLA would split the draws too and gather
    # them piece by piece.
    whole = NamedSharding(mesh, PartitionSpec())
    return place(jax.lax.with_sharding_constraint(draw(*args), whole), mesh)

  return sample
