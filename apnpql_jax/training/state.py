"""The training state."""

from __future__ import annotations

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.learner import Agent, LearnerState
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.expert import ExpertReplayMaker, empty_expert
from apnpql_jax.training.placement import place, shardings
from apnpql_jax.training.rollout import example_slot
from apnpql_jax.types import Array


class SkippedUpdates(struct.PyTreeNode):
  """Record of the non-finite updates, which are skipped."""

  in_a_row: Array  # i32[]: consecutive ones, up to now
  key: PRNGKeyArray  # typed PRNG key of the last one, to repeat it


class TrainState(struct.PyTreeNode):
  """Everything needed to resume a run."""

  learner: LearnerState
  env: EnvState  # [worlds, ...]
  replay: Replay
  expert_replay: Replay | None
  key: PRNGKeyArray  # typed PRNG key
  env_steps: Array  # i32[]: environment steps done, summed over worlds
  faults: SkippedUpdates


def initial_state(
  config: TrainConfig, env: Env, agent: Agent, expert: ExpertReplayMaker
) -> TrainState:
  """Returns the state of a new run; ``expert`` makes the expert replay."""
  key, row_key, init_key, expert_key, fault_key = _keys(config)
  rows = jax.random.randint(row_key, (config.env.worlds,), 0, env.bank_split)

  @jax.jit
  def start(
    worlds: EnvState, key: PRNGKeyArray, init_key: PRNGKeyArray, fault_key: PRNGKeyArray
  ) -> TrainState:
    length = config.replay.capacity // config.env.worlds
    state = TrainState(
      learner=agent.init(init_key, worlds.observation),
      env=worlds,
      replay=replay.create(example_slot(worlds), length, config.env.worlds),
      expert_replay=None,
      key=key,
      env_steps=jnp.zeros((), jnp.int32),
      faults=SkippedUpdates(in_a_row=jnp.zeros((), jnp.int32), key=fault_key),
    )
    return place(state, env.mesh)

  state = start(env.reset(rows), key, init_key, fault_key)
  state = state.replace(expert_replay=expert(config, env, expert_key))
  # Committed to its devices like a restored state, so that both use one compilation.
  return jax.device_put(state, shardings(state, env.mesh))


def initial_expert(
  config: TrainConfig, env: Env, expert: ExpertReplayMaker
) -> Replay | None:
  """Returns the expert replay of ``initial_state`` alone."""
  ring = expert(config, env, _keys(config)[3])
  return jax.device_put(ring, shardings(ring, env.mesh))


def _keys(config: TrainConfig) -> PRNGKeyArray:
  return jax.random.split(jax.random.key(config.seed), 5)


def example_state(config: TrainConfig, env: Env, agent: Agent) -> TrainState:
  """Returns shapes, dtypes and shardings of the state without allocating it."""
  state = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  return jax.tree.map(
    lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where),
    state,
    shardings(state, env.mesh),
  )
