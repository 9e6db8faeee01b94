"""The functional interface against the batched environment that it is made of."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config.files import task_env
from apnpql_jax.envs.functional import FunctionalEnv, State

WORLDS, PERIODS = 3, 5


@pytest.fixture(
  scope="module", params=["native", pytest.param("mjx", marks=pytest.mark.slow)]
)
def env(request) -> FunctionalEnv:
  config = dataclasses.replace(
    task_env("push_plate"),
    obs="state",
    bank_rows=16,
    backend=request.param,
    time_limit_s=0.45,
  )
  return FunctionalEnv(config)


def play(env: FunctionalEnv, key: jax.Array, actions: jax.Array) -> State:
  """Plays one world in a scan and returns its states, [time, ...]."""

  def period(state: State, action: jax.Array) -> tuple[State, State]:
    after = env.step(state, action)
    return after, after

  return jax.lax.scan(period, env.reset(key), actions)[1]


def test_vmap_equals_one_world_after_the_other(env):
  keys = jax.random.split(jax.random.key(0), WORLDS)
  actions = jax.random.uniform(jax.random.key(1), (WORLDS, PERIODS, 7), minval=-1)
  one = jax.jit(lambda key, actions: play(env, key, actions))
  many = jax.jit(jax.vmap(lambda key, actions: play(env, key, actions)))(keys, actions)
  for world in range(WORLDS):
    alone = one(keys[world], actions[world])
    for name, value in alone.obs.items():
      np.testing.assert_allclose(value, many.obs[name][world], atol=2e-5)
    np.testing.assert_array_equal(alone.done, many.done[world])


def test_a_step_after_the_end_begins_a_random_episode(env):
  keys = jax.random.split(jax.random.key(2), WORLDS)
  still = jnp.zeros((WORLDS, PERIODS, 7))
  states = jax.jit(jax.vmap(lambda key, actions: play(env, key, actions)))(keys, still)
  np.testing.assert_array_equal(states.done[0], [0, 0, 1, 0, 0])
  np.testing.assert_array_equal(states.info["truncation"], states.done)
  assert not states.reward.any() and not states.metrics["success"].any()
  pose = states.obs["robot"][..., -7:]
  assert (abs(pose[:, 3] - pose[:, 2]).max(-1) > 1e-3).all()
  assert len({tuple(x) for x in np.asarray(pose[:, 3]).round(4).tolist()}) > 1


def test_sizes(env):
  assert env.action_size == 7
  assert env.observation_size["robot"] == (21,)
