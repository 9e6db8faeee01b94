"""The losses of the paper as functions of arrays, one number per state.

``s`` candidate actions per state come first, ``*b`` are batch axes and ``n`` counts
atoms. ``_tm1`` is the state acted upon, ``_t`` the state it led to.

``stop_gradient``, here and in ``Heads``, keeps each loss from parameters that it must
not train. One gradient of the sum of all losses therefore serves all steps of the
paper's Algorithm 1.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Float
import optax

from apnpql_jax.dists import categorical
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


def weighted_mean(
  losses: Float[Array, "*b"], weight: Float[Array, "*b"]
) -> Float[Array, ""]:
  """Returns the mean under weights >= 0, or zero if all weights are zero."""
  return jnp.sum(weight * losses) / jnp.maximum(jnp.sum(weight), 1e-6)


def ap_loss(
  predicted: Float[Array, "*b 3 7"], label: Float[Array, "*b 3 7"], *, delta: float
) -> Float[Array, "*b"]:
  """Computes the behavior-cloning loss of the action primitives (paper Eq. 10).

  L^ap = mean Huber(v - v*) / delta + mean cross-entropy(g, g*)

  v are velocities in rad/s and g is the logit of closing the gripper. The Huber loss is
  quadratic below ``delta`` (rad/s), where the arm closes in on its target, and linear
  above, where the labels of distant targets saturate.
  """
  velocity, close = predicted[..., :-1], predicted[..., -1]
  huber = optax.losses.huber_loss(velocity, label[..., :-1], delta=delta) / delta
  entropy = optax.losses.sigmoid_binary_cross_entropy(close, label[..., -1])
  return jnp.mean(huber, axis=(-2, -1)) + jnp.mean(entropy, axis=-1)


def value_target(
  logits_t: Float[Array, " s *b n"],
  weights_t: Float[Array, " s *b"],
  reward_t: Float[Array, "*b"],
  discount_t: Float[Array, "*b"],
  atoms: Float[Array, " n"],
) -> Float[Array, "*b n"]:
  """Computes the distributional N-step target, without gradient (paper Eq. 8, right).

  Z-bar = project(r + gamma^N Z'(s_t, a)), a ~ q

  ``logits_t`` are the target network's Z' of the candidates, r is the discounted sum of
  N rewards, and the discount is zero where the episode terminated.
  """
  # Average over candidates first: the projection is linear, so one per state is enough.
  probs_t = jnp.sum(weights_t[..., None] * jax.nn.softmax(logits_t), axis=0)
  target = categorical.project(probs_t, reward_t, discount_t, atoms)
  return jax.lax.stop_gradient(target)


def q_loss(
  logits_tm1: Float[Array, "*b n"], target: Float[Array, "*b n"]
) -> Float[Array, "*b"]:
  """Computes the cross-entropy L^Q = -sum_j Z-bar_j log Z(s_tm1, a_tm1)_j (Eq. 8)."""
  return optax.losses.softmax_cross_entropy(logits_tm1, target)


def retrace_target(
  reward_t: Float[Array, "*b N"],
  discount_t: Float[Array, "*b N"],
  value_t: Float[Array, "*b N"],
  q_t: Float[Array, "*b N"],
  trace_t: Float[Array, "*b N"],
) -> Float[Array, "*b"]:
  """Computes the Retrace return G_0 of N instants, no gradient (Munos 2016, Eq. 4).

  G_{t-1} = r_t + gamma_t (V(s_t) + c_t (G_t - Q(s_t, a_t))), G_N = Q(s_N, a_N)

  The last axis holds the instants t = 1..N; Q(s_0, a_0) cancels. gamma_t is zero where
  the episode terminated at t; the trace c_t is min(1, pi / mu), or zero where it ended.
  """
  target = q_t[..., -1]  # No data beyond the window, so no correction at its end.
  for t in reversed(range(reward_t.shape[-1])):
    correction = trace_t[..., t] * (target - q_t[..., t])
    target = reward_t[..., t] + discount_t[..., t] * (value_t[..., t] + correction)
  return jax.lax.stop_gradient(target)


def alpha_loss(
  q_tm1: Float[Array, " s *b"], alpha_tm1: Float[Array, "*b"], *, epsilon: float
) -> Float[Array, "*b"]:
  """Computes the dual of KL(q || b) <= epsilon, in nats, over alpha (paper Eq. 7).

  L^alpha = alpha epsilon + alpha log mean_i exp(Q_i / alpha), a_i ~ b

  It is convex in alpha, with slope epsilon - KL(q || b), which is zero at the limit.
  """
  q_tm1 = jax.lax.stop_gradient(q_tm1)
  log_sum = jax.nn.logsumexp(q_tm1 / alpha_tm1[None], axis=0)
  log_mean = log_sum - math.log(q_tm1.shape[0])
  return alpha_tm1 * epsilon + alpha_tm1 * log_mean


def kl_dual(
  kl: Float[Array, "*b"], alpha_tm1: Float[Array, "*b"], *, epsilon: float
) -> Float[Array, "*b"]:
  """Computes the dual of KL(pi || b) <= epsilon, in nats, for a parametric policy.

  L^alpha = alpha (epsilon - KL), whose slope in alpha is that of Eq. 7 with pi for q
  """
  return alpha_tm1 * (epsilon - jax.lax.stop_gradient(kl))


def weighted_nll(
  distribution: ActionDistribution,
  samples: Float[Array, " s *b 7"],
  weights: Float[Array, " s *b"],
) -> Float[Array, "*b"]:
  """Computes -sum_i w_i log p(a_i) of unclipped actions: KL(w || p) plus a constant."""
  samples, weights = jax.lax.stop_gradient((samples, weights))
  return -jnp.sum(weights * distribution.log_prob(samples), axis=0)


def m_step_loss(
  prior: ActionDistribution,
  samples: Float[Array, " s *b 7"],
  weights: Float[Array, " s *b"],
  nu: Float[Array, ""],
) -> Float[Array, "*b"]:
  """Computes the M-step loss of the prior (paper Eq. 9).

  L^M = -sum_i w_i log b(a_i) - nu H(b)

  The first term is KL(q || b) up to a constant. The paper prints + nu H(b) but
  introduces the term for exploration, so entropy is rewarded here. H is a lower bound:
  if it is above the floor, so is the entropy.
  """
  nll = weighted_nll(prior, samples, weights)
  return nll - jax.lax.stop_gradient(nu) * prior.entropy_bound()


def nu_loss(
  nu: Float[Array, ""], entropy: Float[Array, "*b"], *, epsilon_nu: float
) -> Float[Array, "*b"]:
  """Computes the dual of H(b) >= epsilon_nu, in nats (text below paper Eq. 9).

  L^nu = nu (H(b) - epsilon_nu), so nu >= 0 grows while the entropy is below its floor
  """
  return nu * (jax.lax.stop_gradient(entropy) - epsilon_nu)
