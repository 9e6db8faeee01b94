"""The non-parametric policy and its KL limit, against rlax and scipy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from scipy import optimize, special

from apnpql_jax.agents import losses
from apnpql_jax.dists import boltzmann

SAMPLES = 100


def random_q(seed: int, batch: int = 8) -> jax.Array:
  rng = np.random.default_rng(seed)
  return jnp.asarray(rng.beta(0.5, 1.0, size=(SAMPLES, batch)), jnp.float32)


def test_weights_and_alpha_loss_are_those_of_rlax():
  q, alpha = random_q(0), jnp.geomspace(0.02, 2.0, 8)
  expected, weights, _ = rlax.mpo_compute_weights_and_temperature_loss(
    sample_q_values=q,
    temperature_constraint=rlax.LagrangePenalty(alpha, jnp.float32(1.5)),
    projection_operator=lambda x: x,
    sample_axis=0,
  )
  ours = losses.alpha_loss(q, alpha, epsilon=1.5)
  np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-6)
  np.testing.assert_allclose(boltzmann.importance_weights(q, alpha), weights, atol=1e-6)


@pytest.mark.parametrize("epsilon", [0.2, 1.0, 2.5])
def test_the_limit_holds_exactly_at_the_minimum_of_the_dual(epsilon: float):
  q = random_q(1)
  for i in range(q.shape[1]):
    values = np.asarray(q[:, i], np.float64)

    def dual(log_alpha: float, values=values) -> float:
      alpha = np.exp(log_alpha)
      mean = special.logsumexp(values / alpha) - np.log(SAMPLES)
      return alpha * (epsilon + mean)

    found = optimize.minimize_scalar(dual, bounds=(-9.0, 4.0), method="bounded")
    alpha = jnp.exp(jnp.full((1,), found.x, jnp.float32))
    one = q[:, i : i + 1]
    ours = losses.alpha_loss(one, alpha, epsilon=epsilon)[0]
    assert ours == pytest.approx(found.fun, rel=1e-4)
    kl = boltzmann.kl_to_prior(boltzmann.importance_weights(one, alpha))[0]
    assert kl == pytest.approx(epsilon, abs=5e-3)


def test_pick_follows_the_weights():
  q, alpha = random_q(5, batch=2)[:6], jnp.array([0.2, 0.7])
  weights = boltzmann.importance_weights(q, alpha)
  draw = jax.vmap(lambda key: boltzmann.pick(key, weights))
  picked = np.asarray(draw(jax.random.split(jax.random.key(0), 40_000)))
  for i in range(2):
    shares = np.bincount(picked[:, i], minlength=6) / 40_000
    np.testing.assert_allclose(shares, weights[:, i], atol=0.012)
