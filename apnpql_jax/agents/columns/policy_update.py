"""From q to the policy (Table I, column "policy update"), with the temperature's dual.

q = b exp(Q / alpha) / Z is what improves on b. The policy is either q itself or a
parametric pi_psi projected onto it, by forward KL as in MPO or by reverse KL as in SAC.
"""

from __future__ import annotations

from flax import struct
import jax
import jax.numpy as jnp

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy import non_parametric, parametric
from apnpql_jax.agents.heads import Heads
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


class Improvement(struct.PyTreeNode):
  """The improved policy at ``*b`` states and the losses that bring it about."""

  candidates: Candidates  # of q, or of pi_psi where the KL is the reverse one
  weights: Array  # f32[S, *b]: of q on the candidates; sum to one over S
  kl: Array  # f32[*b]: from that policy to the regularizer, nats
  entropy: Array  # f32[*b]: of q, or of pi_psi where there is one, nats
  losses: dict[str, Array]  # f32[*b] each


def none(heads: Heads, prior: ActionDistribution, key: Array) -> Improvement:
  """q as it is; only alpha is trained, by the dual of its limit (paper Eq. 7)."""
  config = heads.config
  q = non_parametric(heads, prior, key, num_samples=config.policy_samples)
  dual = losses.alpha_loss(q.q_values, heads.alpha(), epsilon=config.epsilon)
  kl = boltzmann.kl_to_prior(q.weights)
  return Improvement(q, q.weights, kl, q.entropy, {"loss/alpha": dual})


def forward_kl(heads: Heads, prior: ActionDistribution, key: Array) -> Improvement:
  """min KL(q || pi_psi), moment matching (MPO): weighted likelihood of the candidates.

  The candidates are those of q, drawn from the regularizer.
  """
  step = none(heads, prior, key)
  q, policy = step.candidates, heads.policy()
  fit = losses.weighted_nll(policy, q.samples, q.weights)
  return step.replace(
    entropy=policy.entropy_bound(), losses={**step.losses, "loss/policy": fit}
  )


def reverse_kl(heads: Heads, prior: ActionDistribution, key: Array) -> Improvement:
  """min KL(pi_psi || q), mode seeking (SAC): alpha KL(pi || b) - E_pi[Q].

  The arm is reparameterised, the gripper summed over. The dual of the limit
  KL(pi || b) <= epsilon is alpha (epsilon - KL). Where b is uniform the limit is a
  floor on the entropy: H(pi) >= log volume - epsilon.
  """
  config = heads.config
  pi = parametric(heads, prior, key, num_samples=config.policy_samples)
  log_ratio = pi.base.log_prob(pi.samples) - jax.lax.stop_gradient(prior).log_prob(
    pi.samples
  )
  kl = jnp.sum(pi.weights * log_ratio, axis=0)
  alpha = heads.alpha()
  terms = {
    "loss/policy": jax.lax.stop_gradient(alpha) * kl - pi.value,
    "loss/alpha": losses.kl_dual(kl, alpha, epsilon=config.epsilon),
  }
  # b exp(Q / alpha) / pi, times the weights that pi itself has on its draws.
  tilted = pi.q_values + alpha[None] * (jnp.log(pi.weights) - log_ratio)
  weights = jax.lax.stop_gradient(boltzmann.importance_weights(tilted, alpha))
  return Improvement(pi, weights, kl, pi.base.entropy_bound(), terms)
