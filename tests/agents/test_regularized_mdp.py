"""Theorem III.1 by enumeration: a small MDP whose actions can all be weighed.

The candidates of every state are its actions, repeated in proportion to b, so that the
sample means of ``dists/boltzmann`` are the exact expectations over b. alpha(s) is found
by bisection on the slope of ``alpha_loss``, returns are backed up by ``value_target``.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from apnpql_jax.agents import losses
from apnpql_jax.dists import boltzmann, categorical

STATES, ACTIONS, COPIES = 5, 4, 12
GAMMA = 0.8
EPSILON = 0.4
ATOMS = categorical.support(v_min=0.0, v_max=5.0, num_atoms=101)
"""From the smallest to the largest return, so that no backup leaves them."""


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
  """Importance weights of candidates [C, S] at the alpha(s) of the least dual."""
  slope = jax.grad(
    lambda alpha: jnp.sum(losses.alpha_loss(values, alpha, epsilon=EPSILON))
  )

  def halve(_, ends):
    middle = 0.5 * (ends[0] + ends[1])
    rising = slope(jnp.exp(middle)) > 0.0
    return jnp.where(rising, ends[0], middle), jnp.where(rising, middle, ends[1])

  ends = (jnp.full(STATES, -8.0), jnp.full(STATES, 6.0))
  _, high = jax.lax.fori_loop(0, 40, halve, ends)
  return boltzmann.importance_weights(values, jnp.exp(high))


def weigh_without_limit(values: jax.Array) -> jax.Array:
  """The same at one temperature, whatever the values."""
  return boltzmann.importance_weights(values, jnp.full(STATES, 0.5))


def candidates(q, copies):
  """Values f32[C, S] of the candidates."""
  return jnp.take_along_axis(jnp.asarray(q), copies, axis=1).T


def improved(q, copies):
  """q(a | s) of Eq. 6 with alpha(s) of Eq. 7: probabilities [S, A]."""
  weights = np.asarray(weigh(candidates(q, copies))).T
  pairs = zip(copies, weights, strict=True)
  return np.stack([np.bincount(c, w, minlength=ACTIONS) for c, w in pairs])


@jax.jit
def operator(probs, mdp):
  """T of Eq. 4 on return distributions [S, A, n], as Eq. 8 backs them up."""
  reward, move, copies = mdp
  weights = weigh(candidates(probs @ ATOMS, copies))
  logits = jnp.log(jnp.take_along_axis(probs, copies[..., None], axis=1))
  # One transition from each state by each action to each state, [S, A, S].
  batch = move.shape
  each = losses.value_target(
    jnp.broadcast_to(
      logits.swapaxes(0, 1)[:, None, None], (COPIES, *batch, ATOMS.size)
    ),
    jnp.broadcast_to(weights[:, None, None], (COPIES, *batch)),
    jnp.broadcast_to(reward[..., None], batch),
    jnp.full(batch, GAMMA),
    ATOMS,
  )
  return jnp.sum(move[..., None] * each, axis=2)


def worst_ratio(weigh: Callable[[jax.Array], jax.Array], mdp) -> float:
  """The largest |TQ - TQ'| / |Q - Q'| that random ascents on it find (maximum norm).

  On the means: the backup of a distribution has no other, as the first test shows.
  """
  _, move, copies = mdp

  def value(q):
    values = candidates(q, copies)
    return jnp.sum(weigh(values) * values, axis=0)

  def ratio(q, apart):
    apart = 0.1 * apart
    return GAMMA * jnp.max(jnp.abs(move @ (value(q + apart) - value(q)))) / 0.1

  def climb(carry, key):
    best, q, apart = carry
    keys = jax.random.split(key, 3)
    width = 10.0 ** jax.random.uniform(keys[0], minval=-2.0, maxval=0.0)
    moved = q + width * jax.random.normal(keys[1], q.shape)
    other = jnp.clip(apart + width * jax.random.normal(keys[2], q.shape), -1.0, 1.0)
    other /= jnp.max(jnp.abs(other))
    found = ratio(moved, other), moved, other
    better = found[0] > best
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), found, carry), None

  def ascend(key):
    start = 2.0 * jax.random.normal(key, (2, STATES, ACTIONS))
    (best, *_), _ = jax.lax.scan(climb, (0.0, *start), jax.random.split(key, 1000))
    return best

  keys = jax.random.split(jax.random.key(0), 32)
  return float(jnp.max(jax.jit(jax.vmap(ascend))(keys)))


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


def test_backup_of_a_distribution_has_the_mean_of_the_scalar_one(mdp):
  reward, move, copies = mdp
  shape = (STATES, ACTIONS)
  probs = np.random.default_rng(4).dirichlet(np.full(ATOMS.size, 0.1), shape)
  probs = probs.astype(np.float32)
  q = probs @ np.asarray(ATOMS)
  expected = reward + GAMMA * move @ np.sum(improved(q, copies) * q, axis=1)
  np.testing.assert_allclose(operator(probs, mdp) @ ATOMS, expected, atol=1e-4)


def test_improvement_is_the_best_policy_within_the_limit(mdp):
  """Eqs. 6 and 7 against a solver that knows neither."""
  _, _, copies = mdp
  q = np.random.default_rng(1).random((STATES, ACTIONS)).astype(np.float32)
  values = np.sum(improved(q, copies) * q, axis=1)
  expected = [best_value(*pair) for pair in zip(q, prior_of(copies), strict=True)]
  np.testing.assert_allclose(values, expected, atol=2e-4)


def test_operator_contracts_with_gamma_and_not_faster(mdp):
  assert 0.95 * GAMMA < worst_ratio(weigh, mdp) < GAMMA + 1e-3


def test_without_the_limit_the_operator_need_not_contract(mdp):
  """It is the limit that makes E_q[Q] a maximum over policies, which no value can
  raise by more than its own change; at a given temperature E_q[Q] is none."""
  assert worst_ratio(weigh_without_limit, mdp) > 1.1 * GAMMA


def test_iteration_converges_to_the_optimum_of_the_constrained_problem(mdp):
  reward, move, copies = mdp
  prior = prior_of(copies)
  probs = jnp.zeros((STATES, ACTIONS, ATOMS.size)).at[..., 0].set(1.0)
  optimum = np.zeros((STATES, ACTIONS))
  for _ in range(50):
    probs = operator(probs, mdp)
    values = [best_value(*pair) for pair in zip(optimum, prior, strict=True)]
    optimum = reward + GAMMA * move @ np.array(values)
  q = np.asarray(probs @ ATOMS)
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
