"""Policies of several components: their candidates, losses, start and limits."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any

from densities import scipy_log_prob
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from apnpql_jax.agents.columns import policy_update
from apnpql_jax.agents.columns.policy import parametric
from apnpql_jax.agents.columns.policy_evaluation import TD0
from apnpql_jax.agents.networks import GROUPS, Heads, make_networks
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.dists.action import UniformBox
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.testing import random_batch

FEWEST = 6
"""Candidates of three components: one draw each, with either gripper command."""

REPEATS = 4_000
STD = 0.1  # rad/s; deviation of the joints that are the same in all components
UNIFORM = 7.0 * np.log(2.0)  # minus the log density of the uniform prior
PEAKS = ((0.6, 0.6), (-0.6, -0.6))  # rad/s; of the first two joints

Params = dict[str, Any]
THETA: Params = {
  "logits": np.array([0.5, 0.0, -0.4]),
  "loc": np.array([[0.15, 0.1], [-0.1, 0.0], [0.05, -0.2]]),
  "log_std": np.log([[0.1, 0.07], [0.08, 0.12], [0.1, 0.1]]),
  "gripper_logits": np.array([-1.0, 0.3, 1.5]),
}
"""Three overlapping components, more than five deviations from the action's limits."""


def mixture_of(theta: Params, dim: int) -> GripperGMM:
  """Returns a mixture over ``dim`` joints that differ in the first two only."""
  xp: Any = np if isinstance(theta["loc"], np.ndarray) else jnp
  more = dim - 2
  std = xp.pad(xp.exp(theta["log_std"]), ((0, 0), (0, more)), constant_values=STD)
  return GripperGMM(
    logits=theta["logits"],
    loc=xp.pad(theta["loc"], ((0, 0), (0, more))),
    scale_tril=std[..., None] * np.eye(dim),
    gripper_logits=theta["gripper_logits"],
  )


def nonlinear(actions):
  """Returns a Q in which gripper and arm interact, from actions [*b, D + 1]."""
  wave = (jnp if isinstance(actions, jax.Array) else np).sin(9.0 * actions[..., 0])
  return (actions[..., -1] - 0.3) * (wave + 4.0 * actions[..., 1] * actions[..., 0])


@dataclasses.dataclass(frozen=True)
class KnownValues(Heads):
  """Real networks, but a known Q and, if given, a known policy."""

  known_q: Callable = nonlinear
  mixture: GripperGMM | None = None

  def z(self, actions, *, precision="float32"):
    return self.known_q(actions)[..., None]

  def policy(self):
    return super().policy() if self.mixture is None else self.mixture


@functools.cache
def heads_of(states: int, **settings) -> KnownValues:
  """Returns untrained networks at some states."""
  config = AgentConfig(hidden=(16, 16), feature_dim=8, **settings)
  evaluation = TD0(config)
  networks = make_networks(
    config, GROUPS, evaluation.head(config.hidden), evaluation.value
  )
  seen = random_batch(0, states).observation_tm1
  bound = networks.at(jax.jit(networks.init)(jax.random.key(0), seen), seen)
  return KnownValues(bound.networks, bound.params, bound.phi, None)


def by_quadrature(theta: Params, function: Callable) -> float:
  """Integrates function(actions, log density) under the first two joints' mixture."""
  axis = np.linspace(-0.9, 0.9, 181)
  grid = np.stack(np.meshgrid(axis, axis, (0.0, 1.0), indexing="ij"), axis=-1)
  actions = grid.reshape(-1, 3)
  log_p = scipy_log_prob(mixture_of(theta, 2), actions)
  cell = (axis[1] - axis[0]) ** 2
  assert np.sum(np.exp(log_p)) * cell == pytest.approx(1.0, abs=1e-6)
  return float(np.sum(np.exp(log_p) * function(actions, log_p)) * cell)


def slopes(function: Callable[[Params], float]) -> Params:
  """Returns central differences at ``THETA``."""
  h, found = 1e-4, {name: np.zeros_like(x) for name, x in THETA.items()}
  for name, value in THETA.items():
    for i in np.ndindex(value.shape):
      ends = []
      for sign in (1.0, -1.0):
        moved = value.copy()
        moved[i] += sign * h
        ends.append(function(THETA | {name: moved}))
      found[name][i] = (ends[0] - ends[1]) / (2.0 * h)
  return found


def expected_q(theta: Params) -> float:
  return by_quadrature(theta, lambda actions, _: nonlinear(actions))


def exact_kl(theta: Params) -> float:
  """Returns KL(pi || uniform): four joints are Gaussian, independent of the others."""
  others = 4 * 0.5 * np.log(2.0 * np.pi * np.e * STD**2)
  return by_quadrature(theta, lambda _, log_p: log_p) - others + UNIFORM


@pytest.mark.parametrize(
  ("pick", "exact"),
  [
    (lambda step: step.candidates.value[0], expected_q),
    (lambda step: step.kl[0], exact_kl),
  ],
  ids=["value", "kl"],
)
def test_estimates_and_their_gradients_are_unbiased(pick, exact):
  """With one draw per component; the mean of many must be within five errors."""
  heads = heads_of(1, policy_samples=FEWEST, policy_components=3)

  def estimate(theta, key):
    mixture = jax.tree.map(lambda x: x[None], mixture_of(theta, 6))
    known = dataclasses.replace(heads, mixture=mixture)
    return pick(policy_update.reverse_kl(known, UniformBox((1,), 6), key))

  theta = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), THETA)
  keys = jax.random.split(jax.random.key(1), REPEATS)
  draw = jax.jit(jax.vmap(jax.value_and_grad(estimate), in_axes=(None, 0)))
  found, expected = draw(theta, keys), (exact(THETA), slopes(exact))
  for estimates, truth in zip(
    jax.tree.leaves(found), jax.tree.leaves(expected), strict=True
  ):
    estimates = np.asarray(estimates, np.float64)
    error = estimates.std(0) / np.sqrt(REPEATS)
    assert np.all(np.abs(estimates.mean(0) - truth) < 5.0 * error + 1e-4)
  # Wrong by a component's weight or density, they would be further off than that.
  error = np.std(found[0]) / np.sqrt(REPEATS)
  assert error < 0.02 * max(1.0, abs(expected[0]))


def test_candidates_are_strata_with_the_weights_of_their_components():
  heads = heads_of(4, policy_components=3)
  policy = heads.policy()
  pi = parametric(heads, policy, jax.random.key(0), num_samples=40)
  assert pi.samples.shape == (36, 4, 7)  # Rounded down to a multiple of six.
  np.testing.assert_array_equal(pi.samples[:18, :, 6], 0.0)
  np.testing.assert_array_equal(pi.samples[18:, :, 6], 1.0)
  np.testing.assert_array_equal(pi.samples[:18, :, :6], pi.samples[18:, :, :6])
  shares = np.asarray(pi.weights).reshape(2, 6, 3, 4).sum((0, 1))
  np.testing.assert_allclose(shares.T, jax.nn.softmax(policy.logits), rtol=1e-5)
  expected = policy.log_prob(pi.samples)
  np.testing.assert_allclose(pi.log_prob(pi.samples, pi.q_values), expected, rtol=1e-5)


def two_peaks(actions):
  """Returns a Q of one at either peak, which falls off within 0.2 rad/s."""
  distance = jnp.square(actions[..., None, :2] - jnp.array(PEAKS)).sum(-1)
  return jnp.exp(-0.5 * distance / 0.2**2).max(-1)


def shares_of_peaks(project: Callable, components: int) -> np.ndarray:
  """Descends on psi alone; returns the share of draws within 0.4 rad/s of each peak."""
  settings = {"temperature": "fixed", "initial_alpha": 0.03, "policy_samples": 24}
  heads = heads_of(4, policy_components=components, **settings)
  heads = dataclasses.replace(heads, known_q=two_peaks)
  prior, optimizer = UniformBox((4,), 6), optax.adam(3e-3)

  def at(psi):
    return dataclasses.replace(heads, params={**heads.params, "policy": psi})

  def loss(psi, key):
    return jnp.mean(project(at(psi), prior, key).losses["loss/policy"])

  def descend(carry, key):
    psi, state = carry
    steps, state = optimizer.update(jax.grad(loss)(psi, key), state, psi)
    return (optax.apply_updates(psi, steps), state), None

  psi = heads.params["policy"]
  keys = jax.random.split(jax.random.key(2), 300)
  (psi, _), _ = jax.jit(lambda carry: jax.lax.scan(descend, carry, keys))(
    (psi, optimizer.init(psi))
  )
  draws = at(psi).policy().sample(seed=jax.random.key(3), sample_shape=500)
  distance = jnp.linalg.norm(draws[..., None, :2] - jnp.array(PEAKS), axis=-1)
  return np.asarray(jnp.mean(distance < 0.4, axis=(0, 1)))


def test_by_the_reverse_kl_one_component_keeps_one_peak_and_three_keep_both():
  one = shares_of_peaks(policy_update.reverse_kl, 1)
  three = shares_of_peaks(policy_update.reverse_kl, 3)
  assert one.min() < 0.01 and one.max() > 0.9
  assert three.min() > 0.1 and three.sum() > 0.9


def test_by_the_forward_kl_one_component_misses_both_peaks_and_three_keep_both():
  one = shares_of_peaks(policy_update.forward_kl, 1)
  three = shares_of_peaks(policy_update.forward_kl, 3)
  assert one.min() > 0.02 and one.sum() < 0.6
  assert three.min() > 0.1 and three.sum() > 0.9


@pytest.mark.parametrize("head", ["policy", "prior"])
def test_components_start_apart_with_equal_weights(head: str):
  heads = heads_of(4, policy_components=3, prior_mean="learned")
  policy = getattr(heads, head)()
  assert policy.logits.shape == (4, 3)
  np.testing.assert_allclose(jax.nn.softmax(policy.logits), 1.0 / 3.0, atol=0.02)
  apart = policy.loc[:, [0, 0, 1]] - policy.loc[:, [1, 2, 2]]
  assert np.linalg.norm(apart, axis=-1).min() > 0.3
  assert np.abs(policy.loc).max() < 1.0


@pytest.mark.parametrize("num", [2, 3, 8])
@pytest.mark.parametrize("others", [0.0, 50.0])
def test_weights_of_components_cannot_vanish(num: int, others: float):
  heads = heads_of(4, policy_components=num)
  psi = jax.tree.map(jnp.zeros_like, heads.params["policy"])
  bias = psi["out"]["bias"].reshape(num, -1)
  # Per component: six means, 21 entries of the Cholesky factor, weight and gripper.
  assert bias.shape == (num, 29)
  raw = jnp.full(num, others).at[0].set(50.0).at[-1].set(-50.0)
  psi["out"]["bias"] = bias.at[:, 27].set(raw).reshape(-1)
  moved = dataclasses.replace(heads, params={**heads.params, "policy": psi})
  least = jax.nn.softmax(moved.policy().logits).min()
  limit = heads.config.policy_min_prob
  assert 0.99 * limit / (num - 1) <= least <= 1.01 * limit
