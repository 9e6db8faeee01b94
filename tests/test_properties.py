"""Properties of the formulas that hold for any numbers; hypothesis looks for others."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents import objectives
from apnpql_jax.dists import boltzmann, categorical

SAMPLES, BATCH, BINS = 12, 3, 11
ATOMS = categorical.support(v_min=-1.0, v_max=2.0, num_atoms=BINS)


def number(low: float, high: float) -> st.SearchStrategy[float]:
  """A float that f32 holds exactly."""
  return st.floats(low, high, allow_nan=False, width=32)


def arrays(*shape: int, low: float, high: float) -> st.SearchStrategy[np.ndarray]:
  """f32 of the shape, every entry drawn by itself."""
  size = int(np.prod(shape))
  numbers = st.lists(number(low, high), min_size=size, max_size=size)
  return numbers.map(lambda x: np.array(x, np.float32).reshape(shape))


Q = arrays(SAMPLES, BATCH, low=-8.0, high=8.0)
ALPHA = arrays(BATCH, low=0.125, high=16.0)
weigh = jax.jit(boltzmann.importance_weights)
kl_to_prior = jax.jit(boltzmann.kl_to_prior)


@settings(max_examples=60, deadline=None)
@given(q=Q, alpha=ALPHA, shift=number(-8.0, 8.0))
def test_weights_are_a_distribution_that_no_shift_changes(q, alpha, shift):
  weights = weigh(q, alpha)
  np.testing.assert_allclose(weights.sum(0), 1.0, rtol=1e-5)
  np.testing.assert_allclose(weigh(q + np.float32(shift), alpha), weights, atol=1e-4)
  kl = kl_to_prior(weights)
  assert np.all(kl > -1e-5) and np.all(kl < np.log(SAMPLES) + 1e-5)


@settings(max_examples=60, deadline=None)
@given(q=Q, alpha=ALPHA)
def test_a_colder_policy_is_farther_from_the_prior_and_worth_more(q, alpha):
  """From the plain mean of the candidates at one end to the best at the other."""
  weights = [weigh(q, np.float32(f) * alpha) for f in (1e4, 1.0, 0.5, 1e-5)]
  values = [q.mean(0), *(np.sum(w * q, axis=0) for w in weights), q.max(0)]
  kls = [np.zeros(BATCH), *map(kl_to_prior, weights), np.log([SAMPLES] * BATCH)]
  assert np.all(np.diff(values, axis=0) > -1e-4)
  assert np.all(np.diff(kls, axis=0) > -1e-4)
  np.testing.assert_allclose(values[1], values[0], atol=0.1)
  # Candidates that are within 1e-4 of the best need not be told apart.
  np.testing.assert_allclose(values[-2], values[-1], atol=1e-3)


@settings(max_examples=60, deadline=None)
@given(
  logits=arrays(BATCH, BINS, low=-4.0, high=4.0),
  reward=arrays(BATCH, low=-3.0, high=3.0),
  discount=arrays(BATCH, low=0.0, high=1.0),
)
def test_projection_keeps_mass_and_the_clipped_mean(logits, reward, discount):
  probs = jax.nn.softmax(logits)
  projected = categorical.project(
    probs, jnp.asarray(reward), jnp.asarray(discount), ATOMS
  )
  assert np.all(np.asarray(projected) >= 0.0)
  np.testing.assert_allclose(projected.sum(-1), 1.0, atol=1e-5)
  moved = np.clip(reward[:, None] + discount[:, None] * np.asarray(ATOMS), -1.0, 2.0)
  expected = np.sum(probs * moved, axis=-1)
  np.testing.assert_allclose(projected @ ATOMS, expected, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(
  order=st.permutations(range(6)),
  pace=st.permutations(range(SAMPLES)),
  seed=st.integers(0, 2**31 - 1),
)
def test_states_do_not_see_each_other_and_candidates_have_no_order(order, pace, seed):
  rng = np.random.default_rng(seed)

  def draw(*shape: int) -> jax.Array:
    return jnp.asarray(rng.normal(size=shape), jnp.float32)

  logits, q, reward = draw(SAMPLES, 6, BINS), draw(SAMPLES, 6), draw(6)
  alpha, discount = jnp.exp(draw(6)), jax.nn.sigmoid(draw(6))

  def both(logits, q, alpha, reward, discount):
    weights = boltzmann.importance_weights(q, alpha)
    target = objectives.value_target(logits, weights, reward, discount, ATOMS)
    return target, objectives.alpha_loss(q, alpha, epsilon=1.0)

  whole = both(logits, q, alpha, reward, discount)
  states, turn = np.array(order), np.array(pace)
  mixed = both(
    logits[turn][:, states],
    q[turn][:, states],
    alpha[states],
    reward[states],
    discount[states],
  )
  for a, b in zip(whole, mixed, strict=True):
    np.testing.assert_allclose(np.asarray(a)[states], b, rtol=1e-4, atol=1e-5)
