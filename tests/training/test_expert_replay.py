"""The expert replay from demonstrations: which of their instants training draws."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.cli import main
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import demonstrations, replay
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.replay import Replay
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.training import expert
from apnpql_jax.types import Slot, Transition

EPISODES = 4


def _config(*, slots: int, time_limit_s: float = 14.0) -> TrainConfig:
  """Returns settings with so many slots in each column of the expert replay."""
  env = dataclasses.replace(testing.TINY.env, time_limit_s=time_limit_s)
  steps = dataclasses.replace(testing.TINY.replay, expert_steps=slots * env.worlds)
  return dataclasses.replace(testing.TINY, env=env, replay=steps)


def _named(demos: Demonstrations) -> Demonstrations:
  """Returns demonstrations whose actions name their instants."""
  action = np.zeros_like(demos.action)
  action[:, 0] = np.arange(demos.instants) / 128
  return demos._replace(action=action)


def _names(slots: Slot) -> np.ndarray:
  return np.asarray(slots.action)[..., 0] * 128


def _draw(ring: Replay) -> Transition:
  key, n_step = jax.random.key(0), testing.TINY.agent.n_step
  drawn = replay.sample(ring, key, batch_size=512, n_step=n_step, gamma=0.99)
  return jax.tree.map(np.asarray, drawn)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(_config(slots=8).env)


@pytest.fixture(scope="module")
def demos(env) -> Demonstrations:
  demos = expert.record_expert(env, episodes=EPISODES, seed=0, noise=0.0)
  assert demonstrations.solved(demos, env.task, env.config).all()
  return demos


def test_instants_beyond_the_time_limit_are_never_drawn(demos):
  """An episode of three time limits is solved at its end, after a long rest."""
  config = _config(slots=20, time_limit_s=2.25)
  env = make_env(config.env)
  limit = env.config.episode_steps
  length = int(np.flatnonzero(demos.first)[1])
  assert limit < length <= 2 * limit
  index = np.maximum(np.arange(3 * limit + 1) + length - (3 * limit + 1), 0)
  late = _named(demos.rows(index)._replace(first=np.arange(3 * limit + 1) == 0))
  assert not demonstrations.solved(late, env.task, env.config).any()

  ring = expert.replay_from_demonstrations(late, config, env)
  slots = jax.tree.map(np.asarray, ring.slots)
  for name, last in zip(_names(slots).T, slots.timestep.last.T, strict=True):
    np.testing.assert_array_equal(np.unique(name[~last]), np.arange(limit))
  assert not slots.timestep.reward.any()
  assert (_draw(ring).weight == 1).all()


def test_a_rest_after_success_takes_no_slots(demos, env):
  """The replay is that of the episodes without the rest."""
  ends = np.append(demos.first[1:], True)
  resting = demos.rows(np.repeat(np.arange(demos.instants), np.where(ends, 200, 1)))
  assert resting.first.sum() == EPISODES
  config = _config(slots=demos.instants)
  ring = expert.replay_from_demonstrations(resting, config, env)
  expected = expert.replay_from_demonstrations(demos, config, env)
  jax.tree.map(np.testing.assert_array_equal, ring, expected)
  drawn = _draw(ring)
  assert (drawn.weight == 1).all() and drawn.reward_t.any()


def test_a_column_begins_with_the_episode_that_the_one_before_cut_off(demos, env):
  """It begins with the next one if a column is shorter than an episode."""
  named = _named(demos)
  begin, last = np.flatnonzero(named.first), np.append(named.first[1:], True)
  two = int(begin[2]) + 1  # slots of two episodes and one instant of the third
  short = int(np.diff(begin).min()) - 5
  for slots, episodes in (two, [0, 2, 0, 2]), (short, [0, 1, 2, 3]):
    ring = expert.replay_from_demonstrations(named, _config(slots=slots), env)
    index = (begin[episodes] + np.arange(slots)[:, None]) % named.instants
    np.testing.assert_array_equal(_names(ring.slots), index)
    np.testing.assert_array_equal(ring.slots.timestep.last, last[index])


def test_an_object_may_be_out_of_reach_within_an_episode(demos, env, tmp_path):
  """`convert` accepts the file, and training does: only starts must be in reach."""
  lost = 8
  assert not demos.first[lost - 1 : lost + 2].any()
  free, _ = env.task.scene.free_joint("plate")
  qpos = demos.qpos.copy()
  qpos[lost, free] += 2.0
  far, period_s = demos._replace(qpos=qpos), env.config.control_period_s
  recorded, made = tmp_path / "recorded.npz", tmp_path / "made.npz"
  demonstrations.save(recorded, far, task="push_plate", control_period_s=period_s)
  assert main.main(["convert", str(recorded), "push_plate", str(made)]) == 0
  loaded = demonstrations.load(made, env.task, env.config)
  ring = expert.replay_from_demonstrations(loaded, _config(slots=8), env)
  drawn = _draw(ring)
  assert (drawn.weight == 1).all() and np.isfinite(drawn.primitives_tm1).all()
