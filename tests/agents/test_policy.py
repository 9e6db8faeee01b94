"""Policies as weighted candidates: their weights, densities and search."""

from __future__ import annotations

import dataclasses
from typing import Any

from densities import distrax_log_prob, scipy_log_prob
import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from apnpql_jax.agents.columns import policy_update
from apnpql_jax.agents.columns.policy import cem, non_parametric, parametric
from apnpql_jax.agents.columns.policy_evaluation import TD0
from apnpql_jax.agents.networks import GROUPS, Heads, make_networks
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists.action import UniformBox
from apnpql_jax.testing import random_batch

CONFIG = AgentConfig(hidden=(8, 8), feature_dim=8, policy_samples=400)
STATES = 16


@dataclasses.dataclass(frozen=True)
class KnownValues(Heads):
  """Real networks, but Q(s, a) = 1 - |a - goal|^2, half a point more if closed."""

  goal: float = 0.5

  def z(self, actions, *, precision="float32"):
    far = jnp.sum(jnp.square(actions[..., :6] - self.goal), axis=-1)
    return (1.0 - far + 0.5 * actions[..., 6])[..., None]


@pytest.fixture(scope="module")
def heads() -> KnownValues:
  evaluation = TD0(CONFIG)
  head = evaluation.head(CONFIG.hidden)
  networks = make_networks(CONFIG, GROUPS, head, evaluation.value)
  seen = random_batch(0, STATES).observation_tm1
  params = jax.jit(networks.init)(jax.random.key(0), seen)
  params["policy"]["out"]["bias"] = 0.2 * jnp.sin(jnp.arange(29.0))
  bound = networks.at(params, seen)
  return KnownValues(bound.networks, bound.params, bound.phi, None)


@pytest.mark.parametrize("name", ["prior", "policy"])
def test_prior_and_policy_are_distrax_distributions(heads, name: str):
  distribution = getattr(heads, name)()
  assert isinstance(distribution, distrax.Distribution)
  assert distribution.batch_shape == (STATES,)
  assert distribution.event_shape == (7,)
  samples, log_prob = distribution.sample_and_log_prob(
    seed=jax.random.key(7), sample_shape=20
  )
  expected = distrax_log_prob(distribution, samples)
  np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-4)


def test_density_of_q_is_the_prior_times_the_importance_weights(heads):
  prior = heads.prior()
  q = non_parametric(heads, prior, jax.random.key(1), num_samples=50)
  ratio = q.log_prob(q.samples, q.q_values) - prior.log_prob(q.samples)
  np.testing.assert_allclose(jnp.exp(ratio), 50.0 * q.weights, rtol=1e-4)
  np.testing.assert_allclose(q.weights.sum(0), 1.0, rtol=1e-5)
  surprise = -jnp.log(50.0 * q.weights) - prior.log_prob(q.samples)
  np.testing.assert_allclose(q.entropy, jnp.sum(q.weights * surprise, 0), rtol=1e-4)


def test_parametric_policy_sums_over_the_gripper(heads):
  policy = heads.policy()
  pi = parametric(heads, policy, jax.random.key(2), num_samples=400)
  assert pi.samples.shape == (400, STATES, 7)
  closed = jnp.sum(pi.weights * pi.samples[..., 6], axis=0)
  expected = jax.nn.sigmoid(policy.gripper_logits[:, 0])
  np.testing.assert_allclose(closed, expected, rtol=1e-4)
  mean = jnp.sum(pi.weights[..., None] * pi.samples[..., :6], axis=0)
  std = jnp.linalg.norm(policy.scale_tril[:, 0], axis=-1)
  assert np.abs((mean - policy.loc[:, 0]) / std).max() < 5.0 / np.sqrt(200)
  np.testing.assert_allclose(
    pi.log_prob(pi.samples, pi.q_values), policy.log_prob(pi.samples), rtol=1e-5
  )


def test_cross_entropy_method_comes_nearer_than_its_first_draw(heads):
  prior = UniformBox((STATES,), 6)
  best = cem(heads, prior, jax.random.key(3), num_samples=0)
  one = non_parametric(heads, prior, jax.random.key(3), num_samples=128)
  assert best.samples.shape == (64, STATES, 7)
  np.testing.assert_array_equal(best.weights.sum(0), 1.0)
  np.testing.assert_array_equal(best.value, best.q_values.max(0))
  chosen = jnp.sum(best.weights[..., None] * best.actions, axis=0)
  assert np.all(chosen[:, 6] == 1.0)
  # As many draws without a refit find less.
  assert np.mean(best.value) > np.mean(one.q_values.max(0)) + 0.1


def test_cross_entropy_method_is_that_of_qt_opt(heads):
  """Two draws of 64 and a refit to the 6 best in between, one state at a time."""
  prior, keys = heads.prior(), jax.random.split(jax.random.key(6), 2)
  found = cem(heads, prior, jax.random.key(6), num_samples=0)
  first = np.asarray(prior.sample(seed=keys[0], sample_shape=64), np.float64)
  mean, std, close = [], [], []
  for draws in np.moveaxis(first, 1, 0):
    arm = np.clip(draws[:, :6], -1.0, 1.0)
    q = 1.0 - np.sum((arm - heads.goal) ** 2, axis=-1) + 0.5 * draws[:, 6]
    best = np.argsort(q)[-6:]
    mean.append(arm[best].mean(0))
    std.append(arm[best].std(0).clip(0.01))
    close.append(draws[best, 6].mean().clip(0.001, 0.999))
  base: Any = found.base
  np.testing.assert_allclose(base.loc[:, 0], mean, atol=1e-5)
  expected = np.asarray(std)[..., None] * np.eye(6)
  np.testing.assert_allclose(base.scale_tril[:, 0], expected, atol=1e-5)
  np.testing.assert_allclose(
    jax.nn.sigmoid(base.gripper_logits[:, 0]), close, atol=1e-5
  )
  np.testing.assert_array_equal(
    found.samples, base.sample(seed=keys[1], sample_shape=64)
  )


def test_uniform_box_is_uniform():
  box = UniformBox((2,), 6)
  drawn = box.sample(seed=jax.random.key(0), sample_shape=20_000)
  draws = np.asarray(drawn)
  assert draws.shape == (20_000, 2, 7)
  np.testing.assert_allclose(draws[..., :6].mean((0, 1)), 0.0, atol=0.02)
  np.testing.assert_allclose(draws[..., :6].var((0, 1)), 1.0 / 3.0, atol=0.01)
  assert set(np.unique(draws[..., 6])) == {0.0, 1.0}
  assert draws[..., 6].mean() == pytest.approx(0.5, abs=0.01)
  # 64 for the arm, two commands: the density integrates to one.
  assert np.exp(box.log_prob(drawn[:1])) * 2.0**7 == pytest.approx(1.0, rel=1e-5)
  np.testing.assert_allclose(box.entropy_bound(), 7.0 * np.log(2.0), rtol=1e-6)


def test_uniform_box_is_a_distrax_distribution():
  box, key = UniformBox((2,), 6), jax.random.key(1)
  assert isinstance(box, distrax.Distribution)
  assert box.batch_shape == (2,)
  assert box.event_shape == (7,)
  samples, log_prob = box.sample_and_log_prob(seed=key, sample_shape=(3, 4))
  drawn = box.sample(seed=key, sample_shape=(3, 4))
  np.testing.assert_array_equal(samples, drawn)
  # Inside the box the density is that of distrax; outside it does not vanish.
  sides = distrax.Independent(distrax.Uniform(-jnp.ones((2, 6)), 1.0))
  expected = sides.log_prob(samples[..., :6]) - np.log(2.0)
  np.testing.assert_allclose(log_prob, expected, rtol=1e-5)
  np.testing.assert_array_equal(box.log_prob(3.0 * samples), log_prob)
  np.testing.assert_allclose(box.entropy(), sides.entropy() + np.log(2.0), rtol=1e-6)


def test_reverse_kl_weighs_draws_of_pi_as_q_does(heads):
  prior, policy, alpha = heads.prior(), heads.policy(), np.asarray(heads.alpha())
  step = policy_update.reverse_kl(heads, prior, jax.random.key(5))
  pi = step.candidates
  for state in range(3):
    one = jax.tree.map(lambda x, state=state: x[state], (prior, policy))
    actions = np.asarray(pi.samples[:, state], np.float64)
    log_b, log_pi = (scipy_log_prob(mixture, actions) for mixture in one)
    q = np.asarray(pi.q_values[:, state]) / alpha[state]
    expected = special.softmax(log_b + q - log_pi + np.log(pi.weights[:, state]))
    np.testing.assert_allclose(step.weights[:, state], expected, rtol=1e-2, atol=1e-5)


@pytest.mark.parametrize(
  "project", [policy_update.forward_kl, policy_update.reverse_kl]
)
def test_a_projection_brings_the_policy_to_the_better_actions(heads, project):
  """Descent on psi alone moves mean and gripper toward what Q likes."""
  prior = UniformBox((STATES,), 6)

  def loss(psi, key):
    moved = dataclasses.replace(heads, params={**heads.params, "policy": psi})
    return jnp.mean(project(moved, prior, key).losses["loss/policy"])

  def descend(psi, key):
    slope = jax.grad(loss)(psi, key)
    return jax.tree.map(lambda x, g: x - 0.05 * g, psi, slope), None

  keys = jax.random.split(jax.random.key(5), 200)
  psi, _ = jax.jit(lambda p: jax.lax.scan(descend, p, keys))(heads.params["policy"])
  after = dataclasses.replace(heads, params={**heads.params, "policy": psi}).policy()
  before = heads.policy()
  far = [np.abs(x.loc - heads.goal).mean() for x in (before, after)]
  assert far[1] < 0.5 * far[0]
  assert np.all(after.gripper_logits > before.gripper_logits)
