"""Acting rules: which action each takes, in every row of Table I."""

from __future__ import annotations

import dataclasses

from densities import scipy_log_prob
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from apnpql_jax.agents.acting import choose_action
from apnpql_jax.agents.columns.policy import parametric
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.agents.networks import Heads
from apnpql_jax.agents.table_one import ALGORITHMS, algorithm_of
from apnpql_jax.errors import ConfigError
from apnpql_jax.testing import SMALL, random_batch

STATES, KEYS = 6, 4_000
NO_MEANS = "sac"  # Its regularizer is uniform, but its policy is a Gaussian.


def play(name: str, acting: str, **settings):
  """Returns the heads, and actions f32[KEYS, STATES, 7] with their metrics."""
  config = dataclasses.replace(SMALL, algorithm=name, policy_samples=32, **settings)
  agent = make_agent(config)
  observation = random_batch(0, STATES).observation_tm1
  rng = np.random.default_rng(0)
  params = jax.tree.map(
    lambda x: x + 0.3 * jnp.asarray(rng.normal(size=x.shape), jnp.float32),
    agent.init(jax.random.key(0), observation).params,
  )
  heads = agent.networks.at(params, observation)

  @jax.jit
  @jax.vmap
  def act(key):
    return choose_action(algorithm_of(config), heads, key, acting=acting)

  return heads, *jax.device_get(act(jax.random.split(jax.random.key(1), KEYS)))


def means(mixture) -> np.ndarray:
  """Returns each mean with an open and with a closed hand, f32[2 K, STATES, 7]."""
  loc = np.moveaxis(np.asarray(mixture.loc), -2, 0)
  hands = [np.full((*loc.shape[:-1], 1), x, np.float32) for x in (0.0, 1.0)]
  return np.concatenate([np.concatenate([loc, hand], -1) for hand in hands])


def log_density(heads: Heads, name: str, actions: np.ndarray) -> np.ndarray:
  """Returns the policy's log density without its constant, f64[S, STATES]."""
  by_gradient = ALGORITHMS[name].policy is parametric
  mixture = heads.policy() if by_gradient else heads.prior()
  base = np.stack(
    [
      scipy_log_prob(jax.tree.map(lambda x, i=i: x[i], mixture), actions[:, i])
      for i in range(STATES)
    ],
    axis=1,
  )
  if by_gradient:
    return base
  return base + np.asarray(heads.q(jnp.clip(actions, -1.0, 1.0)) / heads.alpha())


@pytest.mark.parametrize(
  ("name", "components"), [("ap_npql", 1), ("ap_mpo", 1), ("ap_mpo", 3), (NO_MEANS, 1)]
)
def test_mean_takes_the_likeliest_mean(name: str, components: int):
  heads, actions, _ = play(name, "mean", policy_components=components)
  points = means(heads.policy() if name != "ap_npql" else heads.prior())
  best = log_density(heads, name, points).argmax(0)
  expected = np.clip(points[best, np.arange(STATES)], -1.0, 1.0)
  expected = np.broadcast_to(expected, actions.shape)
  np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-6)
  if name == "ap_npql" or components > 1:
    assert len(np.unique(best)) > 1  # Else the choice would not be tested.


def test_mean_without_components_takes_the_draw_of_highest_weight():
  _, actions, info = play("ap_npql", "mean", regularizer="uniform")
  np.testing.assert_array_equal(info["q"], info["q_max"])
  assert len(np.unique(actions[:, 0], axis=0)) > 0.9 * KEYS  # Not one mean.


@pytest.mark.parametrize("name", ["ap_npql", "ap_mpo", NO_MEANS])
def test_greedy_takes_the_draw_of_highest_q(name: str):
  _, actions, info = play(name, "greedy")
  np.testing.assert_array_equal(info["q"], info["q_max"])
  assert len(np.unique(actions[:, 0], axis=0)) > 0.9 * KEYS  # Not one mean.
  _, _, drawn = play(name, "policy")
  assert np.mean(info["q"]) > np.mean(drawn["q"])


def test_prior_draws_from_b_whatever_q_is():
  heads, actions, info = play("ap_npql", "prior")
  np.testing.assert_allclose(info["ess"], 1.0)
  prior = heads.prior()
  inside = np.all(np.abs(actions[..., :6]) < 1.0, axis=-1)
  expected = jax.vmap(prior.log_prob)(jnp.asarray(actions)[:, None])[:, 0]
  assert inside.mean() > 0.1
  np.testing.assert_allclose(
    info["log_prob"][inside], expected[inside], rtol=1e-3, atol=1e-4
  )
  check_draws(prior, actions)


def test_policy_draws_from_every_component_by_its_weight():
  """Each action is that of one stratum; the gripper follows the mixture's density."""
  heads, actions, _ = play("ap_mpo", "policy", policy_components=3)
  check_draws(heads.policy(), actions)


def check_draws(mixture, actions: np.ndarray) -> None:
  """Compares actions f32[KEYS, STATES, 7] with the distribution function of a mixture.

  At each joint, at three velocities, and of the gripper.
  """
  limits = np.array([-0.5, 0.0, 0.5])
  std = np.linalg.norm(mixture.scale_tril, axis=-1)[..., None]
  below = stats.norm.cdf(limits, np.asarray(mixture.loc)[..., None], std)
  closed = np.asarray(jax.nn.sigmoid(mixture.gripper_logits))
  weight = np.asarray(jax.nn.softmax(mixture.logits))
  tolerance = 5.0 * 0.5 / np.sqrt(KEYS)
  for share, found in (
    (below, actions[..., :6, None] < limits),  # [STATES, K, 6, 3]
    (closed, actions[..., 6]),
  ):
    expected = np.einsum("sk,sk...->s...", weight, share)
    np.testing.assert_allclose(found.mean(0), expected, rtol=0, atol=tolerance)
    # Else one component would do.
    assert np.ptp(share, axis=1).max() > 5 * tolerance
  assert np.abs(below - (below > 0.5)).max() > 5 * tolerance  # Else means would do.


def test_an_unknown_rule_is_rejected():
  with pytest.raises(ConfigError, match="policy, mean, prior, greedy"):
    play("ap_npql", "best")
