"""Policy updates with the dual of the temperature (Table I, column "policy update").

q = b exp(Q / alpha) / Z improves on b. The policy is either q itself or a parametric
pi_psi projected onto q, by the forward KL as in MPO or by the reverse KL as in SAC.
"""

from __future__ import annotations

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from apnpql_jax.agents import losses
from apnpql_jax.agents.columns.candidates import Candidates
from apnpql_jax.agents.columns.policy import non_parametric, parametric
from apnpql_jax.agents.networks import Heads
from apnpql_jax.dists import boltzmann
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


class Improvement(struct.PyTreeNode):
  """An improved policy at ``*b`` states and the losses that train it."""

  candidates: Candidates
  """Candidates of q, or of pi_psi for the reverse KL."""

  weights: Float[Array, " s *b"]
  """Weights of q on the candidates; sum to one over S."""

  kl: Float[Array, "*b"]
  """KL from the policy of the candidates to the regularizer, nats."""

  entropy: Float[Array, "*b"]
  """Entropy of q, or of pi_psi if there is one, nats."""

  losses: dict[str, Float[Array, "*b"]]
  """Losses by name."""


def keep_q(heads: Heads, prior: ActionDistribution, key: PRNGKeyArray) -> Improvement:
  """Keeps q as the policy; trains only alpha, by the dual of its KL limit (Eq. 7)."""
  config = heads.config
  q = non_parametric(heads, prior, key, num_samples=config.policy_samples)
  dual = losses.alpha_loss(q.q_values, heads.alpha(), epsilon=config.epsilon)
  kl = boltzmann.kl_to_prior(q.weights)
  return Improvement(q, q.weights, kl, q.entropy, {"loss/alpha": dual})


def forward_kl(
  heads: Heads, prior: ActionDistribution, key: PRNGKeyArray
) -> Improvement:
  """Minimizes KL(q || pi_psi) by weighted maximum likelihood (MPO, moment matching).

  A mixture is fitted as a whole: each of its components learns from a candidate in
  proportion to its responsibility for it, as in a gradient step of EM. The step of pi
  has no limit of its own, neither on the means nor on the covariances.
  """
  step = keep_q(heads, prior, key)
  q, policy = step.candidates, heads.policy()
  fit = losses.weighted_nll(policy, q.samples, q.weights)
  terms = {**step.losses, "loss/policy": fit}
  return step.replace(entropy=policy.entropy_bound(), losses=terms)


def reverse_kl(
  heads: Heads, prior: ActionDistribution, key: PRNGKeyArray
) -> Improvement:
  """Minimizes KL(pi_psi || q) through alpha KL(pi || b) - E_pi[Q] (SAC, mode seeking).

  The arm is reparameterized; components and gripper are summed over. log pi is the
  density of the whole mixture. With a uniform b the limit KL(pi || b) <= epsilon is a
  floor on the entropy: H(pi) >= log volume - epsilon.
  """
  config = heads.config
  pi = parametric(heads, prior, key, num_samples=config.policy_samples)
  log_pi = pi.base.log_prob(pi.samples)
  log_ratio = log_pi - jax.lax.stop_gradient(prior).log_prob(pi.samples)
  kl = jnp.sum(pi.weights * log_ratio, axis=0)
  alpha = heads.alpha()
  terms = {
    "loss/policy": jax.lax.stop_gradient(alpha) * kl - pi.value,
    "loss/alpha": losses.kl_dual(kl, alpha, epsilon=config.epsilon),
  }
  # b exp(Q / alpha) / pi, times the weights of pi on its own draws.
  tilted = pi.q_values + alpha[None] * (jnp.log(pi.weights) - log_ratio)
  weights = jax.lax.stop_gradient(boltzmann.importance_weights(tilted, alpha))
  return Improvement(pi, weights, kl, pi.base.entropy_bound(), terms)
