"""Value targets: Retrace compared with rlax and a loop, windows, double Q."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax

from apnpql_jax.agents import losses
from apnpql_jax.agents.learner import bellman_target, make_agent
from apnpql_jax.agents.table_one import algorithm_of
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.testing import random_batch

N = 4
BATCH = 5
CONFIG = AgentConfig(
  hidden=(8, 8), feature_dim=8, target_samples=6, policy_samples=6, n_step=N, gamma=0.9
)


def random_array(seed: int, *shape: int) -> jax.Array:
  return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def test_retrace_target_matches_rlax():
  reward, value, q, ratio = (random_array(i, BATCH, N) for i in range(4))
  discount = jnp.abs(random_array(4, BATCH, N)).clip(0.0, 1.0)
  ours = losses.retrace_target(
    reward, discount, value, q, jnp.minimum(jnp.exp(ratio), 1.0)
  )
  q_tm1 = random_array(5, BATCH, N)  # Only the first one matters, and it cancels.
  q_tm1 = q_tm1.at[:, 1:].set(q[:, :-1])
  error: Any = jax.vmap(rlax.retrace_continuous, (0, 0, 0, 0, 0, 0, None))(
    q_tm1, q[:, :-1], value, reward, discount, ratio[:, :-1], 1.0
  )
  np.testing.assert_allclose(ours, error[:, 0] + q_tm1[:, 0], rtol=1e-4, atol=1e-5)


def test_retrace_without_correction_is_the_n_step_return():
  """All traces are one, and the values of actions equal those of their states."""
  reward, value = random_array(0, BATCH, N), random_array(1, BATCH, N)
  discount = jnp.full((BATCH, N), 0.9)
  ours = losses.retrace_target(reward, discount, value, value, jnp.ones((BATCH, N)))
  expected = reward @ (0.9 ** np.arange(N)) + 0.9**N * value[:, -1]
  np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-5)


def agent_with(algorithm: str, evaluation: str, **settings: Any):
  """Returns the agent, its row, and parameters whose values depend on the action."""
  config = dataclasses.replace(
    CONFIG, algorithm=algorithm, policy_evaluation=evaluation, **settings
  )
  agent = make_agent(config)
  params = jax.jit(agent.networks.init)(
    jax.random.key(0), random_batch(0).observation_tm1
  )
  params["z"] = jax.tree.map(lambda x: 3.0 * x, params["z"])
  params["z"]["out"]["kernel"] = random_array(9, 8, 1)
  return agent, algorithm_of(config), params


def test_retrace_is_rejected_for_a_policy_without_density():
  with pytest.raises(ConfigError, match="ap_cem"):
    agent_with("ap_cem", "retrace")


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("algorithm", ["svg_prior", "ap_npql"])
def test_retrace_over_windows_is_the_sum_over_its_definition(
  algorithm: str, precision: str
):
  """Sums Munos et al., Eq. 4, forward in time for one window after the other."""
  agent, row, params = agent_with(algorithm, "retrace", candidate_precision=precision)
  batch = random_batch(3, BATCH, windows=N)
  key = jax.random.key(1)

  window = batch.window
  assert window is not None
  heads = agent.networks.at(params, window.timestep.observation)
  policy = row.policy(heads, row.regularizer(heads, heads), key, num_samples=6)
  values = np.sum(policy.weights * policy.q_values, axis=0)
  q = agent.networks.value(heads.z(window.action[None], precision=precision))
  if algorithm == "svg_prior":
    log_pi = heads.policy().log_prob(window.action[None])[0]
  else:
    alpha = heads.alpha()
    partition = jnp.mean(jnp.exp(policy.q_values / alpha), axis=0)
    log_pi = heads.prior().log_prob(window.action[None])[0] + q[0] / alpha
    log_pi = log_pi - jnp.log(partition)
  # Ratios on both sides of one; those of unrelated densities would vanish.
  ratio = np.exp(np.random.default_rng(4).normal(size=(BATCH, N)))
  log_prob = log_pi - jnp.asarray(np.log(ratio), jnp.float32)
  batch = batch.replace(window=window.replace(log_prob=log_prob))
  ours = bellman_target(
    agent.networks, row, agent.policy_evaluation, params, batch, key
  )
  q, step = np.asarray(q[0], np.float64), jax.device_get(window.timestep)
  expected = []
  for i in range(BATCH):
    total, product, q_before = 0.0, 1.0, 0.0
    for t in range(N):
      going = 0.9 * (not step.terminated[i, t])
      total += product * (step.reward[i, t] + going * values[i, t] - q_before)
      cut = min(1.0, ratio[i, t]) * (not step.last[i, t])
      product, q_before = product * going * cut, q[i, t]
    expected.append(total)
  np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-4)


def test_scalar_target_is_the_expected_value_after_the_rewards():
  agent, row, params = agent_with("ap_npql", "td0")
  batch, key = random_batch(4, BATCH), jax.random.key(2)
  ours = bellman_target(
    agent.networks, row, agent.policy_evaluation, params, batch, key
  )
  heads = agent.networks.at(params, batch.observation_t)
  q = row.policy(heads, heads.prior(), key, num_samples=6)
  expected = batch.reward_t + batch.discount_t * jnp.sum(q.weights * q.q_values, axis=0)
  np.testing.assert_allclose(ours, expected, rtol=1e-5)
  outputs = random_array(0, BATCH, 1)
  np.testing.assert_allclose(
    agent.policy_evaluation.loss(outputs, expected),
    rlax.l2_loss(outputs[:, 0], expected),
    rtol=1e-5,
  )


def test_double_q_takes_the_smaller_and_trains_both():
  config = dataclasses.replace(CONFIG, algorithm="sac")
  evaluation = algorithm_of(config).policy_evaluation(config)
  outputs, target = random_array(0, 7, 2), random_array(1, 7)
  np.testing.assert_array_equal(evaluation.value(outputs), outputs.min(-1))
  slope = jax.grad(lambda x: evaluation.loss(x, target).sum())(outputs)
  np.testing.assert_allclose(slope, outputs - target[:, None], rtol=1e-6)
  agent = make_agent(config)
  params = jax.jit(agent.networks.init)(
    jax.random.key(0), random_batch(0).observation_tm1
  )
  heads = agent.networks.at(params, random_batch(0).observation_tm1)
  first, second = jnp.moveaxis(heads.z(random_array(2, 3, 16, 7)), -1, 0)
  assert first.shape == (3, 16) and np.any(first != second)
