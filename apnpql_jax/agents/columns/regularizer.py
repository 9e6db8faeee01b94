"""Regularizers and their updates (Table I, "regularizer", "regularizer update")."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates, score
from apnpql_jax.agents.columns.policy import parametric
from apnpql_jax.agents.networks import Heads
from apnpql_jax.dists.action import ActionDistribution, UniformBox
from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ARM_DOF, Array, Transition

Losses = dict[str, Float[Array, "*b"]]


def behavior_prior(heads: Heads, target_heads: Heads) -> GripperGMM:
  """Returns b_theta, a mixture around predicted action primitives (Sec. IV-A)."""
  del target_heads
  return heads.prior()


def previous_policy(heads: Heads, target_heads: Heads) -> GripperGMM:
  """Returns pi_{k-1}, the policy of the target network, a slow average of psi."""
  del heads
  return target_heads.policy()


def uniform(heads: Heads, target_heads: Heads) -> UniformBox:
  """Returns the uniform distribution over the action box."""
  del target_heads
  return UniformBox(heads.phi.shape[:-1], ARM_DOF)


def no_update(*_: Any) -> Losses:
  """Returns no losses, for regularizers without parameters of their own."""
  return {}


def fit_candidates(
  heads: Heads,
  prior: ActionDistribution,
  candidates: Candidates,
  batch: Transition,
  key: PRNGKeyArray,
  nu: Float[Array, ""],
) -> Losses:
  """Fits b to the policy of the candidates: min KL(q || b) or KL(pi || b) (Eq. 9)."""
  del batch, key
  return _fit(heads, prior, candidates.samples, candidates.weights, nu)


def fit_advantageous(
  heads: Heads,
  prior: ActionDistribution,
  candidates: Candidates,
  batch: Transition,
  key: PRNGKeyArray,
  nu: Float[Array, ""],
) -> Losses:
  """Fits b to replayed actions with Q(s, a) >= E_pi[Q(s, .)] (ABM, Siegel 2020)."""
  del candidates
  samples = batch.action_tm1[None]
  # Other draws than those of the policy update, which splits the key in two.
  key = jax.random.fold_in(key, 2)
  policy = parametric(heads, prior, key, num_samples=heads.config.policy_samples)
  good = score(heads, samples)[2] >= policy.value[None]
  return _fit(heads, prior, samples, good.astype(samples.dtype), nu)


def fit_expert(
  heads: Heads,
  prior: ActionDistribution,
  candidates: Candidates,
  batch: Transition,
  key: PRNGKeyArray,
  nu: Float[Array, ""],
) -> Losses:
  """Fits b to the scripted expert in all visited states (DAgger, Ross et al. 2011)."""
  del candidates, key
  if batch.expert_tm1 is None:
    raise ValueError(
      "there is no expert to imitate: pass label_expert=True to make_env"
    )
  samples = batch.expert_tm1[None]
  return _fit(heads, prior, samples, jnp.ones(samples.shape[:-1]), nu)


def _fit(
  heads: Heads,
  prior: ActionDistribution,
  samples: Float[Array, " s *b 7"],
  weights: Float[Array, " s *b"],
  nu: Float[Array, ""],
) -> Losses:
  """Returns the M-step's loss and the dual of the entropy floor."""
  floor = heads.config.epsilon_nu
  return {
    "loss/m": losses.m_step_loss(prior, samples, weights, nu),
    "loss/nu": losses.nu_loss(nu, prior.entropy_bound(), epsilon_nu=floor),
  }
