"""The functional interface against the batched environment that it is made of."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config.files import task_env
from apnpql_jax.envs.functional import FunctionalEnv, State

WORLDS, PERIODS = 3, 5


def make(**settings: Any) -> FunctionalEnv:
  small: dict[str, Any] = {"obs": "state", "bank_rows": 16, "backend": "native"}
  return FunctionalEnv(dataclasses.replace(task_env("push_plate"), **small | settings))


@pytest.fixture(
  scope="module", params=["native", pytest.param("mjx", marks=pytest.mark.slow)]
)
def env(request) -> FunctionalEnv:
  return make(backend=request.param, time_limit_s=0.45)


def begun(env: FunctionalEnv, worlds: int = WORLDS) -> State:
  return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(2), worlds))


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


def test_vmap_of_vmap_equals_one_of_all_worlds(env):
  keys = jax.random.split(jax.random.key(3), 6)
  actions = jax.random.uniform(jax.random.key(4), (6, 7), minval=-1)

  def played(key: jax.Array, action: jax.Array) -> State:
    return env.step(env.reset(key), action)

  flat = jax.jit(jax.vmap(played))(keys, actions)
  nested = jax.jit(jax.vmap(jax.vmap(played)))(
    keys.reshape(2, 3), actions.reshape(2, 3, 7)
  )
  for name, value in flat.obs.items():
    assert nested.obs[name].shape == (2, 3, *value.shape[1:])
    found = nested.obs[name].reshape(value.shape)
    np.testing.assert_allclose(found, value, atol=2e-5)
  same_keys = jax.random.key_data(nested.info["rng"]).reshape(6, -1)
  np.testing.assert_array_equal(same_keys, jax.random.key_data(flat.info["rng"]))


def test_the_gripper_closes_where_its_command_is_positive(env):
  """So that actions in [-1, 1], as those of Brax's policies, mean the same."""
  commands = jnp.array([-1.0, 0.0, 0.3, 1.0])
  state = jax.jit(jax.vmap(env.reset))(jnp.tile(jax.random.key(5), 4))
  for _ in range(2):
    actions = jnp.zeros((4, 7)).at[:, -1].set(commands)
    state = jax.jit(jax.vmap(env.step))(state, actions)
  joints = np.asarray(state.pipeline_state.physics.qpos)
  np.testing.assert_allclose(joints[::2], joints[1::2], atol=1e-5)
  finger = env.env.task.scene.gripper_qpos
  assert abs(joints[2, finger] - joints[1, finger]) > 0.05


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


def test_the_expert_ends_episodes_by_success():
  env = make()

  def period(state: State, _: None) -> tuple[State, State]:
    action = env.env.expert_action(state.pipeline_state)
    after = jax.vmap(env.step)(state, action)
    return after, after

  states = jax.jit(lambda state: jax.lax.scan(period, state, length=93)[1])(begun(env))
  worlds, done = np.arange(WORLDS), np.asarray(states.done)
  last = done.argmax(0)
  for found in (done, states.reward, states.metrics["success"]):
    np.testing.assert_array_equal(found[last, worlds], 1.0)
    np.testing.assert_array_equal(found[last + 1, worlds], 0.0)
  assert not states.info["truncation"][last, worlds].any()
  np.testing.assert_array_equal(states.reward, states.metrics["success"])


def test_every_reset_draws_a_new_world():
  """Of 12 rows of the bank, which many of the worlds share."""
  fields = begun(make(randomize=True), 32).pipeline_state.physics.fields
  worlds = np.concatenate([x.reshape(32, -1) for x in fields.values()], axis=-1)
  assert len(np.unique(worlds.round(5), axis=0)) == 32


def test_a_world_that_breaks_ends_its_episode(env):
  """Its observation stays that of the episode, as its next state is of another one."""
  before, step = begun(env), jax.jit(jax.vmap(env.step))
  actions = jnp.zeros((WORLDS, 7)).at[1, 0].set(jnp.nan)
  after = step(before, actions)
  for flag in (after.done, after.info["truncation"], after.info["fault"]):
    np.testing.assert_array_equal(flag, [0, 1, 0])
  assert not after.reward.any() and not after.metrics["success"].any()
  robot = [np.asarray(x.obs["robot"]) for x in (before, after)]
  np.testing.assert_array_equal((robot[0] == robot[1]).all(-1), [False, True, False])
  begins = step(after, jnp.zeros((WORLDS, 7)))
  assert not begins.done.any() and not begins.info["fault"].any()
  assert (begins.obs["robot"][1] != after.obs["robot"][1]).any()


def test_what_wrappers_add_to_a_state_is_kept(env):
  """As Brax's ``EpisodeWrapper`` does; a scan needs the same keys in all states."""
  state = begun(env)
  steps, sums = jnp.arange(3.0), {"reward": jnp.ones(WORLDS)}
  state = state.replace(
    info=state.info | {"steps": steps, "episode_metrics": sums},
    metrics=state.metrics | {"distance": steps},
  )

  def period(state: State, action: jax.Array) -> tuple[State, None]:
    return jax.vmap(env.step)(state, action), None

  after, _ = jax.lax.scan(period, state, jnp.zeros((PERIODS, WORLDS, 7)))
  np.testing.assert_array_equal(after.info["steps"], steps)
  np.testing.assert_array_equal(after.metrics["distance"], steps)
  np.testing.assert_array_equal(after.info["episode_metrics"]["reward"], 1.0)


def test_sizes(env):
  assert env.action_size == 7
  assert env.observation_size["robot"] == (21,)
