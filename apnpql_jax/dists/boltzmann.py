"""The non-parametric policy q = b exp(Q / alpha) / Z on samples of the prior b.

All functions take S candidate values per state, drawn from b, on the leading axis:
``q_values`` is f32[S, *b], ``alpha`` is f32[*b] > 0 (paper Sec. III-B).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

Array = jax.Array


def importance_weights(q_values: Array, alpha: Array) -> Array:
  """Self-normalized importance weights softmax(Q / alpha), f32[S, *b] (Eq. 6)."""
  return jax.nn.softmax(q_values / alpha[None], axis=0)


def kl_to_prior(weights: Array) -> Array:
  """Estimate of KL(q || b) = sum_i w_i log(S w_i) in nats, f32[*b]; at most log S."""
  # xlogy-like: a weight that underflowed to zero contributes zero, not nan.
  safe = jnp.where(weights > 0.0, weights, 1.0)
  return jnp.sum(weights * jnp.log(safe), axis=0) + math.log(weights.shape[0])


def effective_sample_size(weights: Array) -> Array:
  """Kish's 1 / sum_i w_i^2, f32[*b], between 1 and S."""
  return 1.0 / jnp.sum(jnp.square(weights), axis=0)


def dual(q_values: Array, alpha: Array, *, epsilon: float) -> Array:
  """Dual of max_q E_q[Q] s.t. KL(q || b) <= epsilon (paper Eq. 7), f32[*b].

  alpha epsilon + alpha log mean_i exp(Q_i / alpha). Convex in alpha; its slope is
  epsilon - KL(q || b), so the minimum is where the limit holds exactly.
  """
  log_mean = jax.nn.logsumexp(q_values / alpha[None], axis=0) - math.log(
    q_values.shape[0]
  )
  return alpha * epsilon + alpha * log_mean


def pick(key: Array, weights: Array) -> Array:
  """Index i32[*b] of one candidate per state, drawn by f32[S, *b] weights."""
  return jax.random.categorical(key, jnp.log(weights), axis=0)
