"""Acting rules: how one action is chosen from a policy's candidates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.columns.candidates import (
  Candidates,
  all_on_the_highest,
  score,
  with_either_gripper,
)
from apnpql_jax.agents.networks import Heads
from apnpql_jax.agents.table_one import Algorithm
from apnpql_jax.config.checks import ACTING
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.errors import check_name
from apnpql_jax.types import Array, Metrics

SURE = ("mean", "greedy")
"""Rules that put all weight on one candidate."""


def choose_action(
  algorithm: Algorithm, heads: Heads, key: PRNGKeyArray, *, acting: str
) -> tuple[Array, Metrics]:
  """Chooses an action per state.

  Args:
    algorithm: The row of Table I.
    heads: The networks at a batch of states.
    key: Random key.
    acting: The rule: "policy" draws candidates and picks one by its weight (paper
      Sec. III-B); "mean" evaluates the policy's density at the means of its components,
      with either gripper command, and picks the highest; "prior" draws from b, without
      Q; "greedy" takes the candidate of highest Q.

  Returns:
    Actions f32[B, 7] and their metrics, see ``Agent.act``.

  Raises:
    ConfigError: The rule is unknown.
  """
  check_name("acting", acting, ACTING)
  key_candidates, key_pick = jax.random.split(key)
  candidates = _candidates(algorithm, heads, key_candidates, acting)
  q_values, weights = candidates.q_values, candidates.weights
  if acting in SURE:
    chosen = jnp.argmax(weights, axis=0)
  else:
    chosen = boltzmann.pick(key_pick, weights)
  actions = jnp.take_along_axis(candidates.actions, chosen[None, :, None], axis=0)
  q = jnp.take_along_axis(q_values, chosen[None], axis=0)
  info = {
    "q": q[0],
    "q_max": jnp.max(q_values, axis=0),
    "alpha": heads.alpha(),
    "ess": boltzmann.effective_sample_size(weights),
    "log_prob": candidates.log_prob(actions, q)[0],
  }
  return actions[0], info


def _candidates(
  algorithm: Algorithm, heads: Heads, key: PRNGKeyArray, acting: str
) -> Candidates:
  prior = algorithm.regularizer(heads, heads)
  if acting == "prior":
    samples = prior.sample(seed=key, sample_shape=1)
    ones = jnp.ones(samples.shape[:-1])
    return Candidates(
      samples, *score(heads, samples), ones, prior, jnp.zeros_like(ones[0])
    )
  drawn = algorithm.policy(heads, prior, key, num_samples=heads.config.policy_samples)
  if acting == "greedy":
    return drawn.replace(weights=all_on_the_highest(drawn.q_values))
  if acting == "mean":
    return _means(heads, drawn)
  return drawn


def _means(heads: Heads, drawn: Candidates) -> Candidates:
  """Puts all weight on the mean, with its gripper command, of highest density.

  A uniform base has no means, so the draw of highest weight replaces them.
  """
  base = drawn.base
  if not isinstance(base, GripperGMM):
    return drawn.replace(weights=all_on_the_highest(drawn.weights))
  samples = with_either_gripper(jnp.moveaxis(base.loc, -2, 0))
  actions, outputs, q_values = score(heads, samples)
  weights = all_on_the_highest(base.log_prob(samples) + drawn.tilt * q_values)
  return Candidates(samples, actions, outputs, q_values, weights, base, drawn.tilt)
