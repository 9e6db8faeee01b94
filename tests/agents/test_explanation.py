"""Explanations: they belong to the action that ``act`` takes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.checks import ACTING
from apnpql_jax.dists import boltzmann
from apnpql_jax.testing import SMALL, random_batch

STATES = 5


def explained(name: str, acting: str = "policy", **settings):
  """Returns an explanation, and the action and metrics of ``act``."""
  agent = make_agent(dataclasses.replace(SMALL, algorithm=name, **settings))
  observation = random_batch(0, STATES).observation_tm1
  rng = np.random.default_rng(0)
  params = jax.tree.map(
    lambda x: x + 0.3 * jnp.asarray(rng.normal(size=x.shape), jnp.float32),
    agent.init(jax.random.key(0), observation).params,
  )
  key = jax.random.key(1)
  found = jax.jit(agent.explain, static_argnames="acting")(
    params, observation, key, acting=acting
  )
  acted = jax.jit(agent.act, static_argnames="acting")(
    params, observation, key, acting=acting
  )
  return jax.device_get(found), jax.device_get(acted)


@pytest.mark.parametrize(
  ("name", "acting"),
  [("ap_npql", acting) for acting in ACTING]
  + [(name, "policy") for name in ("ap_sac", "abm_mpo", "mpo", "sac", "ap_cem")],
)
def test_the_action_is_that_of_act(name: str, acting: str):
  found, (action, info) = explained(name, acting)
  np.testing.assert_array_equal(found.action, action)
  np.testing.assert_array_equal(found.action_q, info["q"])
  np.testing.assert_allclose(found.weights.sum(0), 1.0, rtol=1e-5)
  assert found.q_values.shape == found.weights.shape == found.candidates.shape[:2]
  if name == "sac":
    assert found.prior is None
  else:
    np.testing.assert_allclose(found.prior.shares.sum(-1), 1.0, rtol=1e-5)


@pytest.mark.parametrize("name", ["ap_npql", "ap_sac"])
def test_the_policy_picks_one_of_the_candidates(name: str):
  found, (action, info) = explained(name)
  picked = (found.candidates == action).all(-1)  # [S, STATES]
  np.testing.assert_array_equal(picked.any(0), True)
  for state in range(STATES):
    index = picked[:, state].argmax()
    assert found.q_values[index, state] == info["q"][state]
    assert found.prior.candidates[index, state] == found.prior.chosen[state]


def test_weights_are_those_of_the_boltzmann_step():
  found, (_, info) = explained("ap_npql", initial_alpha=0.05)
  expected = jax.nn.softmax(found.q_values / found.alpha, axis=0)
  np.testing.assert_allclose(found.weights, expected, rtol=1e-5)
  np.testing.assert_allclose(found.kl, boltzmann.kl_to_prior(expected), rtol=1e-4)
  np.testing.assert_allclose(found.ess, info["ess"], rtol=1e-5)
  np.testing.assert_array_equal(found.q_values.max(0), info["q_max"])
  assert found.kl.min() > 0.0


def test_means_are_the_predicted_primitives():
  found, _ = explained("ap_npql")
  arm = np.clip(found.primitives[..., :6], -1.0, 1.0)
  np.testing.assert_array_equal(found.prior.means[..., :6], arm)
  assert ((found.prior.means[..., 6] >= 0) & (found.prior.means[..., 6] <= 1)).all()


def test_one_state_of_many():
  found, _ = explained("ap_npql")
  one = found.at(3)
  np.testing.assert_array_equal(one.q_values, found.q_values[:, 3])
  np.testing.assert_array_equal(one.candidates, found.candidates[:, 3])
  np.testing.assert_array_equal(one.prior.candidates, found.prior.candidates[:, 3])
  np.testing.assert_array_equal(one.prior.shares, found.prior.shares[3])
  np.testing.assert_array_equal(one.primitives, found.primitives[3])
