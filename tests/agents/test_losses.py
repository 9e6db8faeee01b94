"""The losses of AP-NPQL against rlax, scipy and their defining properties."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from scipy import special

from apnpql_jax.agents import losses
from apnpql_jax.dists import boltzmann, categorical
from apnpql_jax.dists.gmm import GripperGMM

ATOMS = categorical.support(v_min=0.0, v_max=1.0, num_atoms=51)


def random_prior(seed: int, batch: int) -> GripperGMM:
  rng = np.random.default_rng(seed)
  below = np.tril(0.1 * rng.normal(size=(batch, 3, 6, 6)), k=-1)
  return GripperGMM(
    logits=jnp.asarray(rng.normal(size=(batch, 3)), jnp.float32),
    loc=jnp.asarray(rng.uniform(-1.0, 1.0, (batch, 3, 6)), jnp.float32),
    scale_tril=jnp.asarray(below + 0.3 * np.eye(6), jnp.float32),
    gripper_logits=jnp.asarray(rng.normal(size=(batch, 3)), jnp.float32),
  )


def random_array(seed: int, *shape: int) -> jax.Array:
  return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def test_weighted_mean_counts_real_transitions_only():
  values = jnp.array([1.0, 2.0, 7.0, 100.0])
  assert losses.weighted_mean(values, jnp.array([1.0, 1.0, 1.0, 0.0])) == (
    pytest.approx(10.0 / 3.0)
  )
  assert losses.weighted_mean(values, jnp.zeros(4)) == 0.0


def test_ap_loss_is_huber_of_velocities_and_cross_entropy_of_the_gripper():
  predicted, label = random_array(0, 5, 3, 7), random_array(1, 5, 3, 7)
  label = label.at[..., 6].set(label[..., 6] > 0)
  error = np.asarray(predicted - label)[..., :6]
  close = special.expit(np.asarray(predicted[..., 6], np.float64))
  likelihood = np.where(label[..., 6] > 0, close, 1 - close)
  expected = special.huber(0.1, error).mean((1, 2)) / 0.1 - np.log(likelihood).mean(1)
  ours = losses.ap_loss(predicted, label, delta=0.1)
  np.testing.assert_allclose(ours, expected, rtol=1e-5)


def test_value_target_is_the_weighted_mean_of_projected_candidates():
  logits = random_array(2, 12, 4, 51)
  weights = jax.nn.softmax(random_array(3, 12, 4), axis=0)
  reward = jnp.array([0.0, 1.0, 0.3, 0.0])
  discount = jnp.array([0.97, 0.0, 0.97, 0.9])
  ours = losses.value_target(logits, weights, reward, discount, ATOMS)
  project = jax.vmap(rlax.categorical_l2_project, (None, 0, None))
  for i in range(4):
    moved = reward[i] + discount[i] * ATOMS
    each = project(moved, jax.nn.softmax(logits[:, i]), ATOMS)
    np.testing.assert_allclose(ours[i], weights[:, i] @ each, atol=1e-5)


def test_value_target_of_a_terminal_transition_is_its_reward():
  logits = random_array(4, 12, 2, 51)
  weights = jnp.full((12, 2), 1.0 / 12.0)
  target = losses.value_target(
    logits, weights, jnp.array([1.0, 0.0]), jnp.zeros(2), ATOMS
  )
  np.testing.assert_allclose(target, np.eye(51)[[50, 0]], atol=1e-6)


def test_value_target_carries_no_gradient():
  def total(logits: jax.Array) -> jax.Array:
    weights = jax.nn.softmax(logits[..., 0], axis=0)
    target = losses.value_target(
      logits, weights, jnp.zeros(2), jnp.full((2,), 0.9), ATOMS
    )
    return jnp.sum(target * ATOMS)

  assert not np.any(jax.grad(total)(random_array(5, 6, 2, 51)))


def test_q_loss_with_one_candidate_is_the_td_loss_of_rlax():
  logits_tm1, logits_t = random_array(6, 8, 51), random_array(7, 8, 51)
  reward = jnp.linspace(0.0, 1.0, 8)
  discount = jnp.linspace(1.0, 0.0, 8)
  expected = jax.vmap(rlax.categorical_td_learning, (None, 0, 0, 0, None, 0))(
    ATOMS, logits_tm1, reward, discount, ATOMS, logits_t
  )
  target = losses.value_target(
    logits_t[None], jnp.ones((1, 8)), reward, discount, ATOMS
  )
  np.testing.assert_allclose(losses.q_loss(logits_tm1, target), expected, rtol=1e-4)


def test_alpha_descends_to_where_the_limit_holds():
  q = jnp.abs(random_array(8, 100, 6))
  log_alpha = jnp.zeros(6)

  def loss(log_alpha: jax.Array) -> jax.Array:
    return jnp.sum(losses.alpha_loss(q, jnp.exp(log_alpha), epsilon=1.0))

  descend = jax.jit(lambda x: x - jax.grad(loss)(x))
  for _ in range(500):
    log_alpha = descend(log_alpha)
  kl = boltzmann.kl_to_prior(boltzmann.importance_weights(q, jnp.exp(log_alpha)))
  np.testing.assert_allclose(kl, 1.0, atol=1e-3)


def test_alpha_loss_does_not_train_the_values():
  grads = jax.grad(lambda q: jnp.sum(losses.alpha_loss(q, jnp.ones(3), epsilon=1.0)))(
    random_array(9, 10, 3)
  )
  assert not np.any(grads)


def test_m_step_without_entropy_is_the_policy_loss_of_mpo():
  prior = random_prior(0, batch=4)
  samples = prior.sample(seed=jax.random.key(0), sample_shape=64)
  q, alpha = random_array(10, 64, 4), jnp.full((4,), 0.7)
  weights = boltzmann.importance_weights(q, alpha)
  ours = losses.m_step_loss(prior, samples, weights, jnp.zeros(()))
  zero = rlax.LagrangePenalty(jnp.float32(0.0), jnp.float32(0.0))
  _, outputs = rlax.mpo_loss(
    sample_log_probs=prior.log_prob(samples),
    sample_q_values=q,
    temperature_constraint=rlax.LagrangePenalty(alpha, jnp.float32(1.0)),
    kl_constraints=[(jnp.zeros((4,)), zero)],
    projection_operator=lambda x: x,
    sample_axis=0,
  )
  np.testing.assert_allclose(ours, outputs.policy_loss, rtol=1e-5, atol=1e-5)


def test_m_step_rewards_entropy():
  prior = random_prior(1, batch=2)
  samples = prior.sample(seed=jax.random.key(0), sample_shape=8)
  weights = jnp.full((8, 2), 1.0 / 8.0)
  without, with_nu = (
    losses.m_step_loss(prior, samples, weights, jnp.float32(nu)) for nu in (0.0, 2.0)
  )
  np.testing.assert_allclose(
    without - with_nu, 2.0 * prior.entropy_bound(), rtol=1e-4, atol=1e-4
  )


def test_m_step_trains_neither_samples_nor_weights_nor_nu():
  prior = random_prior(2, batch=2)

  def total(inputs) -> jax.Array:
    return jnp.sum(losses.m_step_loss(prior, *inputs))

  samples = prior.sample(seed=jax.random.key(0), sample_shape=8)
  inputs = (samples, jnp.full((8, 2), 1.0 / 8.0), jnp.float32(0.5))
  assert all(not np.any(g) for g in jax.tree.leaves(jax.grad(total)(inputs)))


def test_m_step_moves_the_prior_toward_the_policy():
  """Descent lowers KL(q || b), here by weighing the right component (Eq. 3)."""
  prior = random_prior(3, batch=1).replace(logits=jnp.zeros((1, 3)))
  samples = prior.sample(seed=jax.random.key(1), sample_shape=2000)
  distance = jnp.linalg.norm(samples[..., :6] - prior.loc[None, :, 1], axis=-1)
  weights = boltzmann.importance_weights(-distance, jnp.full((1,), 0.1))

  @jax.jit
  def loss(logits: jax.Array) -> jax.Array:
    moved = prior.replace(logits=logits)
    return losses.m_step_loss(moved, samples, weights, jnp.zeros(()))[0]

  logits, slope = prior.logits, jax.jit(jax.grad(loss))
  for _ in range(50):
    logits = logits - slope(logits)
  assert loss(logits) < loss(prior.logits)
  assert jax.nn.softmax(logits)[0, 1] > 0.8


@pytest.mark.parametrize("entropy, sign", [(-2.0, 1.0), (3.0, -1.0)])
def test_nu_grows_while_the_entropy_is_below_its_floor(entropy: float, sign: float):
  slope = jax.grad(lambda nu: losses.nu_loss(nu, jnp.float32(entropy), epsilon_nu=0.5))(
    jnp.float32(1.0)
  )
  assert slope == pytest.approx(entropy - 0.5)
  assert np.sign(-slope) == sign


def test_both_duals_of_the_limit_have_its_slack_as_their_slope():
  """Eq. 7 for q, and the dual for a parametric policy, given the same KL."""
  q, alpha = random_array(11, 30, 5), jnp.linspace(0.2, 2.0, 5)
  kl = boltzmann.kl_to_prior(boltzmann.importance_weights(q, alpha))
  of_q, of_pi = (
    jax.grad(lambda a, f=f, x=x: jnp.sum(f(x, a, epsilon=0.7)))(alpha)
    for f, x in ((losses.alpha_loss, q), (losses.kl_dual, kl))
  )
  np.testing.assert_allclose(of_q, of_pi, atol=1e-4)
  np.testing.assert_allclose(of_pi, 0.7 - kl, atol=1e-5)
  assert np.any(kl > 0.7) and np.any(kl < 0.7)
