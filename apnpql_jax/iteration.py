"""The state of a run and the one pure function that moves it on."""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jax.sharding import (
  Mesh,
  NamedSharding,
  PartitionSpec,
  Sharding,
  SingleDeviceSharding,
)

from apnpql_jax import replay
from apnpql_jax.agents.learner import Agent, LearnerState
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.env import Env
from apnpql_jax.env_state import EnvState
from apnpql_jax.replay import Replay
from apnpql_jax.rollout import agent_policy, expert_policy, rollout
from apnpql_jax.sharding import AXIS
from apnpql_jax.types import ACTION_DIM, Array, Metrics, Slot, Transition


class Faults(struct.PyTreeNode):
  """Updates that were skipped because something in them was not finite."""

  in_a_row: Array  # i32[]: those at the end of what has been done so far
  key: Array  # typed PRNG key of the last one, from which it can be repeated


class TrainState(struct.PyTreeNode):
  """Everything needed to go on."""

  learner: LearnerState
  env: EnvState  # [worlds, ...]
  replay: Replay
  expert_replay: Replay | None
  key: Array  # typed PRNG key
  env_steps: Array  # i32[]: environment steps done, summed over worlds
  faults: Faults


_SPLIT = {
  EnvState: PartitionSpec(AXIS),
  Slot: PartitionSpec(None, AXIS),  # As the replay holds them, [time, worlds, ...].
  Transition: PartitionSpec(AXIS),
}
"""What is split between devices, and along which axis; of all else each has a copy."""

Iteration = Callable[[TrainState], tuple[TrainState, Metrics]]
ExpertReplay = Callable[[TrainConfig, Env, Array], Replay | None]


def make_iteration(config: TrainConfig, env: Env, agent: Agent) -> Iteration:
  """The jitted iteration (paper Algorithm 1): rollouts, then gradient steps.

  The state is donated: the caller must go on with the one returned.
  """
  sample = make_sample(config, agent, env.mesh)

  def iteration(state: TrainState) -> tuple[TrainState, Metrics]:
    key, rollout_key, update_key = jax.random.split(state.key, 3)
    policy = agent_policy(agent, state.learner.target_params, greedy=False)
    worlds, chunk = rollout(
      env, policy, state.env, rollout_key, length=config.rollout_length
    )
    ring = _remember(state.replay, state.env, worlds, chunk)
    keys = jax.random.split(update_key, config.updates_per_iteration)
    update = functools.partial(_update, agent, sample, ring, state.expert_replay)
    (learner, faults), (metrics, ok) = jax.lax.scan(
      update, (state.learner, state.faults), keys
    )
    metrics = {name: jnp.mean(x, where=ok) for name, x in metrics.items()}
    metrics |= _rollout_metrics(chunk) | {
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


def _update(agent, sample, ring, expert_replay, carry, key) -> Any:
  """One update for ``scan``: it is skipped, and counted, if it is not finite."""
  learner, faults = carry
  sample_key, learn_key = jax.random.split(key)
  batch = sample(ring, expert_replay, sample_key)
  updated, metrics = agent.update(learner, batch, learn_key)
  # The norms of the gradients tell of all losses and parameters; a reward that is not
  # finite, however, can get lost in the limits of the projection.
  norms = {k: v for k, v in metrics.items() if k.startswith("grad_norm/")}
  ok = all_finite((batch, norms, updated.nu))
  learner = jax.tree.map(functools.partial(jnp.where, ok), updated, learner)
  faults = Faults(
    in_a_row=jnp.where(ok, 0, faults.in_a_row + 1),
    key=jnp.where(ok, faults.key, key),
  )
  return (learner, faults), (metrics, ok)


def make_sample(
  config: TrainConfig, agent: Agent, mesh: Mesh | None = None
) -> Callable[..., Transition]:
  """(replay, expert replay, key) -> the batch of one update, [B, ...]."""
  draw = functools.partial(
    replay.sample_mixed,
    batch_size=config.replay.batch_size,
    expert_share=config.replay.expert_share,
    n_step=config.agent.n_step,
    gamma=config.agent.gamma,
    windows=agent.networks.evaluation.windows,
    instants=config.agent.lstm_instants,
  )
  if mesh is None:
    return draw

  def sample(*args: Any) -> Transition:
    # Whole at first: XLA would split the draws too, and collect them piece by piece.
    whole = NamedSharding(mesh, PartitionSpec())
    return place(jax.lax.with_sharding_constraint(draw(*args), whole), mesh)

  return sample


def place(tree: Any, mesh: Mesh | None) -> Any:
  """Inside jit: the same tree, each part of which lies where ``_SPLIT`` says."""
  if mesh is None:
    return tree
  return jax.lax.with_sharding_constraint(tree, shardings(tree, mesh))


def shardings(tree: Any, mesh: Mesh | None) -> Any:
  """Where ``place`` puts each leaf; on the default device if there is no mesh."""

  def of(part: Any) -> Any:
    where: Sharding = SingleDeviceSharding(jax.local_devices()[0])
    if mesh is not None:
      where = NamedSharding(mesh, _SPLIT.get(type(part), PartitionSpec()))
    return jax.tree.map(lambda _: where, part)

  return jax.tree.map(of, tree, is_leaf=lambda part: type(part) in _SPLIT)


def all_finite(tree: Any) -> Array:
  """bool[]: no leaf holds a NaN or an infinity."""
  return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


def _remember(ring: Replay, before: EnvState, after: EnvState, chunk: Slot) -> Replay:
  """Adds a chunk; of a world that broke in it, the episode and the rest is excluded."""
  steps = before.elapsed + chunk.action.shape[0]
  broken = after.faults > before.faults
  return replay.exclude(replay.add(ring, chunk), jnp.where(broken, steps, 0))


def _rollout_metrics(chunk: Slot) -> Metrics:
  return {
    "rollout/successes": chunk.timestep.terminated.sum(),
    "rollout/timeouts": chunk.timestep.truncated.sum(),
    "rollout/close_share": chunk.action[..., -1].mean(),
  }


def initial_state(
  config: TrainConfig, env: Env, agent: Agent, expert: ExpertReplay
) -> TrainState:
  """The state before the first iteration; ``expert`` fills the expert's replay."""
  keys = jax.random.split(jax.random.key(config.seed), 5)
  key, row_key, init_key, expert_key, fault_key = keys
  rows = jax.random.randint(row_key, (config.env.worlds,), 0, env.bank_split)

  @jax.jit
  def start(
    worlds: EnvState, key: Array, init_key: Array, fault_key: Array
  ) -> TrainState:
    length = config.replay.capacity // config.env.worlds
    state = TrainState(
      learner=agent.init(init_key, worlds.seen),
      env=worlds,
      replay=replay.create(example_slot(worlds), length, config.env.worlds),
      expert_replay=None,
      key=key,
      env_steps=jnp.zeros((), jnp.int32),
      faults=Faults(in_a_row=jnp.zeros((), jnp.int32), key=fault_key),
    )
    return place(state, env.mesh)

  state = start(env.reset(rows), key, init_key, fault_key)
  state = state.replace(expert_replay=expert(config, env, expert_key))
  # Bound to its devices, as a restored state is, so that both make the same program.
  return jax.device_put(state, shardings(state, env.mesh))


def example_state(config: TrainConfig, env: Env, agent: Agent) -> TrainState:
  """Shapes, dtypes and devices of the state, without taking memory for it."""
  state = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  return jax.tree.map(
    lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where),
    state,
    shardings(state, env.mesh),
  )


def example_slot(worlds: EnvState) -> Slot:
  """Shapes and dtypes of one replay slot of one world."""
  action: Any = jax.ShapeDtypeStruct((ACTION_DIM,), jnp.float32)
  log_prob: Any = jax.ShapeDtypeStruct((), jnp.float32)
  timestep = jax.tree.map(
    lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), worlds.timestep
  )
  return Slot(timestep=timestep, action=action, log_prob=log_prob)


def empty_expert(config: TrainConfig, env: Env, key: Array) -> Replay | None:
  """An expert's replay with nothing in it, for who needs its shapes only."""
  del key
  worlds = config.env.worlds
  length = config.replay.expert_steps // worlds
  if not length:
    return None
  state = jax.eval_shape(env.reset, jnp.zeros(worlds, jnp.int32))
  return replay.create(example_slot(state), length, worlds)


def collect_expert(config: TrainConfig, env: Env, key: Array) -> Replay | None:
  """The expert's replay: ``replay.expert_steps`` slots of its noisy episodes."""
  worlds = config.env.worlds
  length = config.replay.expert_steps // worlds
  if not length:
    return None
  policy = expert_policy(env, noise=config.replay.expert_noise)
  row_key, play_key = jax.random.split(key)
  rows = jax.random.randint(row_key, (worlds,), 0, env.bank_split)

  @jax.jit
  def collect(state: EnvState, key: Array) -> Replay:
    after, chunk = rollout(env, policy, state, key, length=length)
    ring = replay.create(example_slot(state), length, worlds)
    return place(_remember(ring, state, after, chunk), env.mesh)

  return collect(env.reset(rows), play_key)
