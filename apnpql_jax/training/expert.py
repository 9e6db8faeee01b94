"""The expert replay, filled by the scripted expert or from demonstrations."""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import demonstrations, replay
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.replay import Replay
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.randomization.randomize import make_randomize, seen_only
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.training.placement import place
from apnpql_jax.training.rollout import (
  add_chunk,
  example_slot,
  expert_policy,
  rollout,
)
from apnpql_jax.types import Array, Slot

ExpertReplayMaker = Callable[[TrainConfig, Env, PRNGKeyArray], Replay | None]
"""(settings, worlds, key) -> expert replay, or None if it has no slots."""

RecordedStates = Callable[[Demonstrations, Array | np.ndarray], PhysicsState]
"""(one instant per world, the numbers of their episodes) -> states of the worlds."""

CERTAIN = 100.0
"""Log density in nats of actions of an unknown policy: so high that Retrace cuts the
trace."""


def empty_expert(config: TrainConfig, env: Env, key: PRNGKeyArray) -> Replay | None:
  """Returns an empty expert replay, to get its shapes."""
  del key
  worlds, length = config.env.worlds, _length(config)
  state = jax.eval_shape(env.reset, jnp.zeros(worlds, jnp.int32))
  return replay.create(example_slot(state), length, worlds) if length else None


def collect_expert(config: TrainConfig, env: Env, key: PRNGKeyArray) -> Replay | None:
  """Returns an expert replay of noisy episodes of the scripted expert."""
  worlds, length = config.env.worlds, _length(config)
  if not length:
    return None
  policy = expert_policy(env, noise=config.replay.expert_noise)
  row_key, play_key = jax.random.split(key)
  rows = jax.random.randint(row_key, (worlds,), 0, env.bank_split)

  @jax.jit
  def collect(state: EnvState, key: PRNGKeyArray) -> Replay:
    after, chunk = rollout(env, policy, state, key, length=length)
    ring = replay.create(example_slot(state), length, worlds)
    return place(add_chunk(ring, state, after, chunk), env.mesh)

  return collect(env.reset(rows), play_key)


def replay_from_demonstrations(
  demos: Demonstrations,
  config: TrainConfig,
  env: Env,
  key: PRNGKeyArray | None = None,
) -> Replay:
  """Returns an expert replay made from demonstrations.

  Instants after the first success of an episode or beyond its time limit are left out.
  Each column of the ring holds consecutive episodes, repeated or cut off to fill
  ``replay.expert_steps`` slots. With ``env.randomize``, each episode in it draws what
  the cameras see; the physics of a demonstration is that of its recording.

  Args:
    demos: The demonstrations.
    config: Settings of the run.
    env: Its worlds.
    key: Draws what is seen; that of the run's seed if None.
  """
  key = jax.random.key(config.seed) if key is None else key
  worlds, length = config.env.worlds, _length(config)
  kept = demonstrations.until_end(demos, env.task, env.config)
  columns, ends = _columns(demos.first[kept], length, worlds)
  index = kept[columns]
  recorded = demos.rows(index)
  targets = np.zeros((length, worlds, 3, 6), np.float32)
  targets[recorded.first] = demonstrations.solve_targets(
    demos, index[recorded.first], env.task
  )
  # Number the episodes column by column, so that each has a draw of its own.
  episode = np.cumsum(recorded.first.T).reshape(worlds, length).T
  states = _make_states(config, env, key)
  before = env.reset(jnp.zeros(worlds, jnp.int32))
  # The fields that are drawn are fewer than those of the worlds.
  before = before.replace(physics=states(recorded.rows(np.array(0)), episode[0]))
  observe_all = jax.jit(functools.partial(_observe_all, env, states))
  return observe_all(before, (recorded, targets, ends, episode))


def _make_states(config: TrainConfig, env: Env, key: PRNGKeyArray) -> RecordedStates:
  """Returns how recorded instants become states, with drawn worlds if wanted."""
  scene = env.task.scene
  if not config.env.randomize:
    return lambda recorded, episode: recorded.states(scene)
  randomize = make_randomize(seen_only(config.env.randomization), scene)

  def states(recorded: Demonstrations, episode: Array | np.ndarray) -> PhysicsState:
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, episode)
    return randomize(recorded.states(scene), keys)

  return states


def _observe_all(
  env: Env,
  states: RecordedStates,
  before: EnvState,
  instants: tuple[Demonstrations, Array, Array, Array],
) -> Replay:
  """Returns the replay of what the worlds observe at recorded instants.

  ``before`` holds any worlds of the right shapes. ``instants`` are, [length, worlds,
  ...] each, what was recorded, the joint targets of the primitives where an episode
  begins, where one ends, and its number.
  """
  length, worlds = instants[0].first.shape

  def step(before: EnvState, inputs: tuple) -> tuple[EnvState, Slot]:
    recorded, targets, ends, episode = inputs
    now = states(recorded, episode)
    state = env.observe(Arrival.after(before, now, targets, recorded.first))
    timestep = state.timestep
    timestep = timestep.replace(
      truncated=timestep.truncated | ends & ~timestep.terminated
    )
    action = jnp.asarray(recorded.action, jnp.float32)
    return state, Slot(timestep, action, jnp.full(worlds, CERTAIN, jnp.float32))

  _, chunk = jax.lax.scan(step, before, instants)
  ring = replay.add(replay.create(example_slot(before), length, worlds), chunk)
  return place(ring, env.mesh)


def _columns(
  first: np.ndarray, length: int, worlds: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns which instants the columns hold, and where episodes end, [length, worlds].

  A column begins where an episode does, because only there are the episode's time and
  the targets of its primitives known. It begins with the episode that the column before
  cut off, or with the next one if a column is shorter than an episode.
  """
  begin, last = np.flatnonzero(first), np.append(first[1:], True)
  episode, columns = 0, []
  for _ in range(worlds):
    columns.append((begin[episode] + np.arange(length)) % len(first))
    whole = int(last[columns[-1]].sum())
    episode = (episode + max(whole, 1)) % len(begin)
  index = np.stack(columns, axis=1)
  return index, last[index]


def record_expert(
  env: Env, *, episodes: int, seed: int, noise: float
) -> Demonstrations:
  """Returns episodes of the task's scripted expert, up to success or time-out.

  They start from training rows of the bank. Episodes that became non-finite are left
  out.
  """
  policy = expert_policy(env, noise=noise)
  row_key, key = jax.random.split(jax.random.key(seed))
  rows = jax.random.randint(row_key, (episodes,), 0, env.bank_split)

  @jax.jit
  def play(start: EnvState, key: PRNGKeyArray) -> Any:
    def period(state: EnvState, key: PRNGKeyArray) -> tuple[EnvState, Any]:
      policy_key, env_key = jax.random.split(key)
      action, _ = policy(state, policy_key)
      after = env.step(state, action, env_key)
      return after, (state.physics, action, state.timestep.last, state.faults)

    keys = jax.random.split(key, env.config.episode_steps + 1)
    return jax.lax.scan(period, start, keys)[1]

  played = play(env.reset(rows), key)
  played = jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 1, 0), played)
  state, action, last, faults = played  # [episodes, time, ...]
  end = last.argmax(1)  # The first end; every finite episode has one.
  finite = last.any(1) & (faults[np.arange(episodes), end] == 0)
  time = np.arange(last.shape[1])
  inside = time <= np.where(finite, end, -1)[:, None]
  variant, first = np.broadcast_arrays(
    np.asarray(env.variant(rows))[:, None], time == 0
  )
  arrays = state.qpos, state.qvel, state.mocap_pos, state.mocap_quat, variant, action
  return Demonstrations(*(x[inside] for x in arrays), first[inside])


def _length(config: TrainConfig) -> int:
  """Returns the slots per world of the expert replay."""
  return config.replay.expert_steps // config.env.worlds
