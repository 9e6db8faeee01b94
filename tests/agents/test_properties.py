"""Properties of the formulas that hold for any numbers; hypothesis looks for others."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.agents import losses
from apnpql_jax.dists import boltzmann, categorical
from apnpql_jax.dists.gmm import GripperGMM

SAMPLES, BATCH, BINS = 12, 3, 11
ATOMS = categorical.support(v_min=-1.0, v_max=2.0, num_atoms=BINS)


def number(low: float, high: float) -> st.SearchStrategy[float]:
  """Draws a float that f32 holds exactly."""
  return st.floats(low, high, allow_nan=False, width=32)


def arrays(*shape: int, low: float, high: float) -> st.SearchStrategy[np.ndarray]:
  """Draws f32 of the shape, every entry by itself."""
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
  weights = [weigh(q, np.float32(f) * alpha) for f in (1e5, 1.0, 0.5, 1e-5)]
  values = [q.mean(0), *(np.sum(w * q, axis=0) for w in weights), q.max(0)]
  kls = [np.zeros(BATCH), *map(kl_to_prior, weights), np.log([SAMPLES] * BATCH)]
  assert np.all(np.diff(values, axis=0) > -1e-4)
  assert np.all(np.diff(kls, axis=0) > -1e-4)
  np.testing.assert_allclose(values[1], values[0], atol=0.1)
  # Candidates that are within 1e-4 of the best need not be told apart.
  np.testing.assert_allclose(values[-2], values[-1], atol=1e-3)
  sizes = [np.asarray(boltzmann.effective_sample_size(w)) for w in weights]
  assert np.all(np.diff(sizes, axis=0) < 1e-3)
  np.testing.assert_allclose(weights[0], 1.0 / SAMPLES, rtol=2e-3)
  np.testing.assert_allclose(sizes[0], SAMPLES, rtol=1e-4)
  best = np.sum(q > q.max(0) - 0.01, axis=0)
  assert np.all(sizes[-1] > 1.0 - 1e-5) and np.all(sizes[-1] < best + 1e-3)


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
  np.testing.assert_allclose(categorical.mean(projected, ATOMS), expected, atol=1e-4)


@jax.jit
def losses_of(draws: dict, states: dict) -> dict:
  """Returns every formula of the learner, f32[6, ...] each, by what it is called."""
  q, samples, alpha = draws["q"], draws["samples"], states["alpha"]
  weights = boltzmann.importance_weights(q, alpha)
  target = losses.value_target(
    draws["logits"], weights, states["reward"], states["discount"], ATOMS
  )
  kl, steps = boltzmann.kl_to_prior(weights), states["steps"]
  prior, nu = states["prior"], jnp.float32(0.3)
  return {
    "target": target,
    "q": losses.q_loss(states["logits"], target),
    "ap": losses.ap_loss(states["predicted"], states["label"], delta=0.1),
    "retrace": losses.retrace_target(*jnp.moveaxis(steps, -1, 0)),
    "alpha": losses.alpha_loss(q, alpha, epsilon=1.0),
    "kl": losses.kl_dual(kl, alpha, epsilon=1.0),
    "policy": losses.weighted_nll(prior, samples, weights),
    "m": losses.m_step_loss(prior, samples, weights, nu),
    "nu": losses.nu_loss(nu, prior.entropy_bound(), epsilon_nu=-1.0),
  }


@settings(max_examples=20, deadline=None)
@given(
  # Not only in another order: with some twice, a mean over states would show.
  order=st.permutations(range(6)) | st.lists(st.integers(0, 5), min_size=6, max_size=6),
  pace=st.permutations(range(SAMPLES)),
  seed=st.integers(0, 2**31 - 1),
)
def test_states_do_not_see_each_other_and_candidates_have_no_order(order, pace, seed):
  rng = np.random.default_rng(seed)

  def draw(*shape: int) -> jax.Array:
    return jnp.asarray(rng.normal(size=shape), jnp.float32)

  below = 0.3 * draw(6, 3, 2, 2)
  prior = GripperGMM(
    logits=draw(6, 3),
    loc=draw(6, 3, 2),
    scale_tril=jnp.tril(below, -1) + jnp.eye(2) * jnp.exp(draw(6, 3, 2, 1)),
    gripper_logits=draw(6, 3),
  )
  samples = draw(SAMPLES, 6, 3)
  draws = {
    "q": draw(SAMPLES, 6),
    "logits": draw(SAMPLES, 6, BINS),
    "samples": samples.at[..., -1].set(samples[..., -1] > 0.0),
  }
  states = {
    "alpha": jnp.exp(draw(6)),
    "reward": draw(6),
    "discount": jax.nn.sigmoid(draw(6)),
    "logits": draw(6, BINS),
    "predicted": draw(6, 3, 7),
    "label": jax.nn.sigmoid(draw(6, 3, 7)),
    "steps": draw(6, 4, 5),
    "prior": prior,
  }
  turn, places = np.array(pace), np.array(order)
  mixed = losses_of(
    jax.tree.map(lambda x: x[turn][:, places], draws),
    jax.tree.map(lambda x: x[places], states),
  )
  for name, whole in losses_of(draws, states).items():
    np.testing.assert_allclose(
      np.asarray(whole)[places], mixed[name], rtol=1e-4, atol=1e-4, err_msg=name
    )
