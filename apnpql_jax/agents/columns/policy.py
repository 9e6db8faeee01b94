"""Policies as weighted candidate actions (Table I, column "policy").

Each takes the heads at a batch of states, the regularizer b at the same states, a key
and the number S of candidates. ``agents/acting.py`` chooses one of them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.columns.candidates import (
  Candidates,
  all_on_the_highest,
  clip_action,
  score,
  with_either_gripper,
)
from apnpql_jax.agents.networks import Heads
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ARM_DOF, Array

# Settings of the cross-entropy method, as in QT-Opt (Kalashnikov 2018).
CEM_ITERATIONS, CEM_SAMPLES, CEM_ELITES = 2, 64, 6
CEM_MIN_STD = 0.01  # rad/s; floor of the elites' deviation, to keep draws apart


def non_parametric(
  heads: Heads,
  prior: ActionDistribution,
  key: PRNGKeyArray,
  *,
  num_samples: int,
) -> Candidates:
  """Samples q = b exp(Q / alpha) / Z by self-normalized importance sampling (Eq. 6).

  Candidates are drawn from b and have weights softmax(Q / alpha), without gradient.
  """
  heads, prior = heads.frozen(), jax.lax.stop_gradient(prior)
  samples = prior.sample(seed=key, sample_shape=num_samples)
  actions, outputs, q_values = score(heads, samples)
  alpha = heads.alpha()
  weights = boltzmann.importance_weights(q_values, alpha)
  return Candidates(samples, actions, outputs, q_values, weights, prior, 1.0 / alpha)


def prior_alone(
  heads: Heads,
  prior: ActionDistribution,
  key: PRNGKeyArray,
  *,
  num_samples: int,
) -> Candidates:
  """Samples b with equal weights, without regard to Q."""
  drawn = non_parametric(heads, prior, key, num_samples=num_samples)
  equal = jnp.full_like(drawn.weights, 1.0 / num_samples)
  return drawn.replace(weights=equal, tilt=jnp.zeros_like(drawn.tilt))


def parametric(
  heads: Heads,
  prior: ActionDistribution,
  key: PRNGKeyArray,
  *,
  num_samples: int,
) -> Candidates:
  """Samples the arm from pi_psi and pairs each draw with both gripper commands.

  Each of the K components draws S / 2K times, and its draws share its weight, so the
  sum over components is exact (stratified sampling). The two candidates of a draw share
  its weight in proportion to their density under pi, so the sum over the gripper is
  exact, too. S is rounded down to a multiple of 2K. Gradients reach only psi, through
  draws and weights.
  """
  del prior
  policy = heads.policy()
  draws = num_samples // (2 * policy.logits.shape[-1])
  arm = policy.sample_each(key, draws)
  samples = with_either_gripper(arm.reshape(-1, *arm.shape[2:]))
  actions, outputs, q_values = score(heads.frozen(), samples)
  log_prob = policy.log_prob(samples).reshape(2, *arm.shape[:-1])
  component = jnp.moveaxis(jnp.asarray(policy.choice.probs), -1, 0)
  weights = component[None, None] * jax.nn.softmax(log_prob, axis=0) / draws
  weights = weights.reshape(q_values.shape)
  tilt = jnp.zeros(q_values.shape[1:])
  return Candidates(samples, actions, outputs, q_values, weights, policy, tilt)


def cem(
  heads: Heads,
  prior: ActionDistribution,
  key: PRNGKeyArray,
  *,
  num_samples: int,
) -> Candidates:
  """Finds the best action by the cross-entropy method (QT-Opt), starting from b.

  All weight is on the best action of the last draw, without gradient.
  """
  del num_samples
  heads, base = heads.frozen(), jax.lax.stop_gradient(prior)
  *keys, last = jax.random.split(key, CEM_ITERATIONS)
  for k in keys:
    samples = base.sample(seed=k, sample_shape=CEM_SAMPLES)
    base = _refit(samples, score(heads, samples)[2], heads.config.policy_min_prob)
  samples = base.sample(seed=last, sample_shape=CEM_SAMPLES)
  actions, outputs, q_values = score(heads, samples)
  weights = all_on_the_highest(q_values)
  tilt = jnp.zeros(q_values.shape[1:])
  return Candidates(samples, actions, outputs, q_values, weights, base, tilt)


def _refit(samples: Array, q_values: Array, min_prob: float) -> GripperGMM:
  """Fits a diagonal Gaussian and a gripper probability to the best few of S draws."""
  elites = jax.lax.top_k(jnp.moveaxis(q_values, 0, -1), CEM_ELITES)[1]
  elites = jnp.moveaxis(elites, -1, 0)[..., None]
  best = clip_action(jnp.take_along_axis(samples, elites, axis=0))
  mean, std = jnp.mean(best, axis=0), jnp.std(best, axis=0)
  close = jnp.clip(mean[..., -1], min_prob, 1.0 - min_prob)
  joint = jnp.arange(ARM_DOF)
  scale = jnp.zeros((*close.shape, 1, ARM_DOF, ARM_DOF))
  std = jnp.maximum(std[..., None, :-1], CEM_MIN_STD)
  return GripperGMM(
    logits=jnp.zeros((*close.shape, 1)),
    loc=mean[..., None, :-1],
    scale_tril=scale.at[..., joint, joint].set(std),
    gripper_logits=(jnp.log(close) - jnp.log1p(-close))[..., None],
  )
