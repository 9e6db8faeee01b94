"""Agent of the row ap_npql: optimizers, targets, determinism, learning."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from apnpql_jax.agents.learner import make_agent, make_optimizer
from apnpql_jax.agents.table_one import ALGORITHMS
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.testing import random_batch

CONFIG = AgentConfig(
  hidden=(32, 32),
  feature_dim=32,
  target_samples=16,
  policy_samples=12,
  learning_rate_e=4e-4,
  learning_rate_m=3e-4,
  learning_rate_alpha=2e-4,
  learning_rate_nu=1e-4,
  epsilon_nu=5.0,
)
BATCH = 16


@pytest.fixture(scope="module")
def agent():
  return make_agent(CONFIG)


@pytest.fixture(scope="module")
def state(agent):
  return agent.init(jax.random.key(0), random_batch(0).observation_tm1)


@pytest.fixture(scope="module")
def update(agent):
  with jax.numpy_rank_promotion("raise"):
    compiled = jax.jit(agent.update)
    example = agent.init(jax.random.key(0), random_batch(0).observation_tm1)
    compiled(example, random_batch(0), jax.random.key(0))
  return compiled


def test_each_group_moves_at_its_own_learning_rate(state, update):
  """The first step of Adam has the size of its learning rate."""
  after, _ = update(state, random_batch(1), jax.random.key(0))
  rates = {
    "encoder": 4e-4,
    "ap": 4e-4,
    "z": 4e-4,
    "bp": 3e-4,
    "alpha": 2e-4,
  }
  assert set(state.params) == set(rates)
  for group in rates:
    moved = jax.tree.map(
      lambda a, b: np.abs(a - b).max(), after.params[group], state.params[group]
    )
    largest = max(jax.tree.leaves(moved))
    assert largest == pytest.approx(rates[group], rel=0.02), group
  assert after.nu == pytest.approx(1e-4, rel=0.02)  # The entropy is below its floor.
  assert after.step == 1


def test_target_network_is_the_moving_average_of_all_parameters(state, update):
  after, _ = update(state, random_batch(1), jax.random.key(0))
  expected = optax.incremental_update(after.params, state.target_params, 0.05)
  for a, b in zip(
    jax.tree.leaves(after.target_params), jax.tree.leaves(expected), strict=True
  ):
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)


def test_nu_never_falls_below_zero(agent):
  config = dataclasses.replace(CONFIG, epsilon_nu=-50.0)
  agent = make_agent(config)
  state = agent.init(jax.random.key(0), random_batch(0).observation_tm1)
  after, metrics = jax.jit(agent.update)(state, random_batch(1), jax.random.key(0))
  assert after.nu == 0.0
  assert metrics["prior/entropy"] > -50.0


def test_m_step_waits_for_its_delay():
  groups = ("encoder", "bp", "policy")
  optimizer = make_optimizer(dataclasses.replace(CONFIG, m_step_delay=2), groups)
  trained = dict.fromkeys((*groups, "nu"), jnp.ones(3))
  opt_state = optimizer.init(trained)
  moved = []
  for _ in range(3):
    steps, opt_state = optimizer.update(trained, opt_state, trained)
    after = jax.tree.map(jnp.add, trained, steps)
    moved.append({k for k in trained if np.any(after[k] != trained[k])})
  assert moved == [set(trained) - {"bp"}] * 2 + [set(trained)]


def test_learning_rates_decay_along_a_cosine_to_a_tenth():
  config = dataclasses.replace(CONFIG, decay_updates=4)
  optimizer = make_optimizer(config, ("encoder", "bp", "alpha"))
  trained = dict.fromkeys(("encoder", "bp", "alpha", "nu"), jnp.ones(3))
  opt_state, taken = optimizer.init(trained), []
  for _ in range(6):
    # With a constant gradient, Adam moves by the learning rate.
    updates, opt_state = optimizer.update(trained, opt_state, trained)
    steps: Any = updates
    taken.append([-float(steps[k][0]) for k in ("encoder", "bp", "alpha")])
  cosine = 0.5 + 0.5 * np.cos(np.pi * np.minimum(np.arange(6), 4) / 4)
  share = 0.1 + 0.9 * cosine
  rates = config.learning_rate_e, config.learning_rate_m
  np.testing.assert_allclose(np.array(taken)[:, :2], np.outer(share, rates), rtol=1e-4)
  np.testing.assert_allclose(
    np.array(taken)[:, 2], config.learning_rate_alpha, rtol=1e-4
  )


def test_transitions_of_weight_zero_change_nothing(state, update):
  batch = random_batch(2)
  weight = batch.weight.at[5:].set(0.0)
  garbage = random_batch(3)
  other = jax.tree.map(lambda a, b: a.at[5:].set(b[5:]), batch, garbage)
  one, _ = update(state, batch.replace(weight=weight), jax.random.key(0))
  two, _ = update(state, other.replace(weight=weight), jax.random.key(0))
  for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
    np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
  three, _ = update(state, other, jax.random.key(0))
  assert not np.allclose(
    one.params["ap"]["out"]["bias"], three.params["ap"]["out"]["bias"], atol=1e-6
  )


def test_an_update_ignores_the_order_of_a_batch(state, update):
  """All candidates of the target have equal values here.

  The candidates of a state depend on its position in the batch.
  """
  z = dict(state.target_params["z"])
  z["action"] = jax.tree.map(jnp.zeros_like, z["action"])
  z["out"] = z["out"] | {"kernel": 1000.0 * z["out"]["kernel"]}
  state = state.replace(target_params=state.target_params | {"z": z})
  batch, order = random_batch(9), np.random.default_rng(0).permutation(BATCH)
  batch = batch.replace(weight=jnp.linspace(0.1, 1.0, BATCH))
  mixed = jax.tree.map(lambda x: x[order], batch)
  apart = batch.replace(observation_t=mixed.observation_t)
  one, two, other = (
    update(state, x, jax.random.key(0))[1] for x in (batch, mixed, apart)
  )
  for name in ("loss/q", "loss/ap", "ap/error", "q/data", "q/target"):
    np.testing.assert_allclose(one[name], two[name], rtol=1e-5, err_msg=name)
  # The states to bootstrap from matter, and so does their pairing with the others.
  assert abs(one["loss/q"] - other["loss/q"]) > 1e-3 * one["loss/q"]


def test_update_is_deterministic_and_follows_its_key(state, update):
  batch = random_batch(4)
  first, again, other = (
    jax.tree.leaves(update(state, batch, jax.random.key(k))) for k in (1, 1, 2)
  )
  assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
  assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_losses_fall_on_a_fixed_batch(agent, state):
  """Without bootstrapping the targets are fixed, so they can be memorized."""
  batch = random_batch(5)
  batch = batch.replace(discount_t=jnp.zeros(BATCH))

  def body(state, key):
    return agent.update(state, batch, key)

  keys = jax.random.split(jax.random.key(0), 800)
  _, metrics = jax.jit(lambda s: jax.lax.scan(body, s, keys))(state)
  assert all(np.all(np.isfinite(v)) for v in metrics.values())
  for name in ("loss/q", "loss/ap", "ap/error"):
    first, last = metrics[name][:10].mean(), metrics[name][-10:].mean()
    assert last < 0.3 * first, name
  # The temperature follows its dual, so that the KL limit becomes active.
  kl = metrics["npql/kl_over_eps"]
  assert kl[:10].mean() < 0.1
  assert 0.4 < kl[-100:].mean() < 1.5


@pytest.mark.parametrize("camera", ["global_image", "wrist_image"])
def test_both_cameras_are_trained_by_the_value(agent, camera: str):
  batch = random_batch(6, batch=2, pixels=True)
  networks = agent.networks
  params = jax.jit(networks.init)(jax.random.key(0), batch.observation_tm1)

  def values(params):
    heads = networks.at(params, batch.observation_tm1)
    return jnp.sum(heads.z(batch.action_tm1[None])[..., 0])

  grads = jax.jit(jax.grad(values))(params)["encoder"][camera]
  assert all(np.any(g) for g in jax.tree.leaves(grads))


def test_actions_lie_in_the_action_box(agent, state):
  params = jax.tree.map(lambda x: x, state.params)
  params["ap"]["out"]["bias"] = jnp.linspace(-3.0, 3.0, 21)
  actions, info = jax.jit(agent.act)(
    params, random_batch(7).observation_tm1, jax.random.key(0)
  )
  assert actions.shape == (BATCH, 7)
  assert np.all(np.abs(actions) <= 1.0)
  assert np.abs(actions[:, :6]).max() == 1.0
  assert set(np.unique(actions[:, 6])) <= {0.0, 1.0}
  assert all(v.shape == (BATCH,) for v in info.values())


def test_greedy_takes_the_highest_q(agent, state):
  """The parameters are set to prefer a closed gripper and a fast first joint."""
  params = jax.tree.map(lambda x: x, state.params)
  z = {k: jax.tree.map(jnp.zeros_like, v) for k, v in params["z"].items()}
  z["action"]["kernel"] = z["action"]["kernel"].at[0, 0].set(1.0).at[6, 0].set(5.0)
  z["phi"]["bias"] = z["phi"]["bias"].at[0].set(10.0)
  z["Dense_0"]["kernel"] = z["Dense_0"]["kernel"].at[0, 0].set(1.0)
  z["out"]["kernel"] = (
    z["out"]["kernel"].at[0].set(0.2 * jnp.linspace(0.0, 1.0, CONFIG.num_atoms))
  )
  params["z"] = z
  observation = random_batch(8).observation_tm1
  act = jax.jit(agent.act, static_argnames="acting")
  keys = [jax.random.key(k) for k in range(30)]
  greedy = [act(params, observation, k, acting="greedy") for k in keys]
  drawn = [act(params, observation, k) for k in keys]
  for actions, info in greedy:
    np.testing.assert_array_equal(info["q"], info["q_max"])
    assert np.all(actions[:, 6] == 1.0)
  mean_speed = [np.mean([a[:, 0] for a, _ in x]) for x in (greedy, drawn)]
  assert mean_speed[0] > mean_speed[1]
  assert any(np.any(info["q"] < info["q_max"]) for _, info in drawn)


def test_an_agent_that_no_default_replay_could_train_is_accepted():
  """The settings of the environment and of the replay are not the agent's."""
  make_agent(dataclasses.replace(CONFIG, n_step=2_000))


def test_a_limit_that_the_samples_cannot_reach_is_rejected():
  with pytest.raises(ConfigError, match="epsilon"):
    make_agent(dataclasses.replace(CONFIG, epsilon=float(np.log(12)) + 1e-6))


def test_the_error_for_an_unknown_algorithm_names_the_valid_ones():
  with pytest.raises(ConfigError, match=", ".join(ALGORITHMS)):
    make_agent(dataclasses.replace(CONFIG, algorithm="dqn"))
