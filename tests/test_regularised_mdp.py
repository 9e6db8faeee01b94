"""Theorem III.1 by enumeration: a small MDP whose actions can all be weighed.

The candidates of every state are its actions, repeated in proportion to b, so that the
sample means of ``dists/boltzmann`` are the exact expectations over b. alpha(s) is found
by bisection on the slope of the dual.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from apnpql_jax.dists import boltzmann

STATES, ACTIONS, COPIES = 5, 4, 12
GAMMA = 0.8
EPSILON = 0.4


@pytest.fixture(scope="module")
def mdp():
  """Rewards [S, A], transitions [S, A, S], and which action each candidate copies."""
  rng = np.random.default_rng(0)
  reward = rng.random((STATES, ACTIONS)).astype(np.float32)
  move = rng.dirichlet(np.ones(STATES), (STATES, ACTIONS)).astype(np.float32)
  counts = [rng.multinomial(COPIES - ACTIONS, [0.25] * 4) + 1 for _ in range(STATES)]
  copies = np.stack([np.repeat(np.arange(ACTIONS), c) for c in counts])
  return reward, move, copies


@jax.jit
def weigh(values: jax.Array) -> jax.Array:
  """Importance weights of candidates [C, S] at the alpha(s) where KL is EPSILON."""

  def halve(_, ends):
    middle = 0.5 * (ends[0] + ends[1])
    weights = boltzmann.importance_weights(values, jnp.exp(middle))
    far = boltzmann.kl_to_prior(weights) > EPSILON
    return jnp.where(far, middle, ends[0]), jnp.where(far, ends[1], middle)

  ends = (jnp.full(STATES, -9.0), jnp.full(STATES, 6.0))
  _, high = jax.lax.fori_loop(0, 60, halve, ends)
  return boltzmann.importance_weights(values, jnp.exp(high))


def improved(q, copies):
  """q(a | s) of Eq. 6 with alpha(s) of Eq. 7: probabilities [S, A]."""
  weights = np.asarray(weigh(np.take_along_axis(q, copies, axis=1).T)).T
  pairs = zip(copies, weights, strict=True)
  return np.stack([np.bincount(c, w, minlength=ACTIONS) for c, w in pairs])


def operator(q, mdp):
  """T Q = r + gamma E[max over KL <= epsilon of E_pi Q] (Eq. 4)."""
  reward, move, copies = mdp
  return reward + GAMMA * move @ np.sum(improved(q, copies) * q, axis=1)


def best_value(q, prior):
  """max_pi E_pi[q] s.t. KL(pi || prior) <= EPSILON, by a general constrained solver."""

  def kl(pi):
    return np.sum(pi * np.log(np.maximum(pi, 1e-12) / prior))

  found = optimize.minimize(
    lambda pi: -pi @ q,
    prior,
    bounds=[(1e-9, 1.0)] * ACTIONS,
    constraints=[
      {"type": "eq", "fun": lambda pi: pi.sum() - 1.0},
      {"type": "ineq", "fun": lambda pi: EPSILON - kl(pi)},
    ],
    options={"ftol": 1e-10},
  )
  return -found.fun


def prior_of(copies):
  return np.stack([np.bincount(c, minlength=ACTIONS) for c in copies]) / COPIES


def test_improvement_is_the_best_policy_within_the_limit(mdp):
  """Eqs. 6 and 7 against a solver that knows neither."""
  _, _, copies = mdp
  q = np.random.default_rng(1).random((STATES, ACTIONS)).astype(np.float32)
  values = np.sum(improved(q, copies) * q, axis=1)
  expected = [best_value(*pair) for pair in zip(q, prior_of(copies), strict=True)]
  np.testing.assert_allclose(values, expected, atol=2e-4)


def test_operator_contracts_with_gamma(mdp):
  rng = np.random.default_rng(2)
  for _ in range(10):
    one, two = rng.normal(size=(2, STATES, ACTIONS)).astype(np.float32)
    moved = np.abs(operator(one, mdp) - operator(two, mdp)).max()
    assert moved <= GAMMA * np.abs(one - two).max() + 1e-4


def test_iteration_converges_to_the_optimum_of_the_constrained_problem(mdp):
  reward, move, copies = mdp
  prior = prior_of(copies)
  q = np.zeros((STATES, ACTIONS), np.float32)
  optimum = np.zeros((STATES, ACTIONS))
  for _ in range(50):
    q = operator(q, mdp)
    values = [best_value(*pair) for pair in zip(optimum, prior, strict=True)]
    optimum = reward + GAMMA * move @ np.array(values)
  np.testing.assert_allclose(q, optimum, atol=5e-3)
  # The policy found is worth what its value says: J of Eq. 1, by a linear solve.
  pi = improved(q, copies)
  chain = np.einsum("sa,sat->st", pi, move)
  worth = np.linalg.solve(np.eye(STATES) - GAMMA * chain, np.sum(pi * reward, axis=1))
  np.testing.assert_allclose(worth, np.sum(pi * q, axis=1), atol=5e-3)
  kl = np.sum(pi * np.log(pi / prior), axis=1)
  np.testing.assert_allclose(kl, EPSILON, atol=1e-3)
  # A policy drawn at random within the limit is worth less, from every state.
  rng = np.random.default_rng(3)
  for _ in range(20):
    other = improved(rng.random((STATES, ACTIONS)).astype(np.float32), copies)
    chain = np.einsum("sa,sat->st", other, move)
    less = np.linalg.solve(
      np.eye(STATES) - GAMMA * chain, np.sum(other * reward, axis=1)
    )
    assert np.all(less <= worth + 1e-3)
