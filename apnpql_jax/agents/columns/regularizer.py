"""What the policy is kept close to, and how that is trained (Table I, columns
"regularizer" and "regularizer update").
"""

from __future__ import annotations

from typing import Any

import jax

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy import parametric
from apnpql_jax.agents.heads import Heads
from apnpql_jax.dists.action import ActionDistribution, UniformBox
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ARM_DOF, Array, Transition

Losses = dict[str, Array]
"""Name -> f32[*b]."""


def behavior_prior(heads: Heads, slow: Heads) -> GripperGMM:
  """b_theta: mixture around the predicted action primitives (paper Sec. IV-A)."""
  del slow
  return heads.prior()


def previous_policy(heads: Heads, slow: Heads) -> GripperGMM:
  """pi_{k-1}: the parametric policy of the target network, the slow average of psi."""
  del heads
  return slow.policy()


def uniform(heads: Heads, slow: Heads) -> UniformBox:
  """The same density for all actions in the box."""
  del slow
  return UniformBox(heads.phi.shape[:-1], ARM_DOF)


def no_update(*_: Any) -> Losses:
  """For regularizers without parameters of their own."""
  return {}


def fit_candidates(
  heads: Heads,
  prior: ActionDistribution,
  candidates: Candidates,
  batch: Transition,
  key: Array,
  nu: Array,
) -> Losses:
  """min KL(q || b) or min KL(pi || b): whichever the candidates stand for (Eq. 9)."""
  del batch, key
  return _fit(heads, prior, candidates.samples, candidates.weights, nu)


def fit_advantageous(
  heads: Heads,
  prior: ActionDistribution,
  candidates: Candidates,
  batch: Transition,
  key: Array,
  nu: Array,
) -> Losses:
  """The advantage-weighted behavior model (ABM, Siegel 2020): max 1[A >= 0] log b(a).

  a is the replayed action, A = Q(s, a) - E_pi[Q(s, .)].
  """
  del candidates
  samples = batch.action_tm1[None]
  # Not the draws that the policy update takes with this key.
  policy = parametric(
    heads,
    prior,
    jax.random.fold_in(key, 1),
    num_samples=heads.config.policy_samples,
  )
  good = heads.q(samples) >= policy.value[None]
  return _fit(heads, prior, samples, good.astype(samples.dtype), nu)


def _fit(
  heads: Heads, prior: ActionDistribution, samples: Array, weights: Array, nu: Array
) -> Losses:
  """M-step and dual of the entropy floor."""
  return {
    "loss/m": losses.m_step_loss(prior, samples, weights, nu),
    "loss/nu": losses.nu_loss(
      nu, prior.entropy_bound(), epsilon_nu=heads.config.epsilon_nu
    ),
  }
