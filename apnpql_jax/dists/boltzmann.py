"""The non-parametric policy q = b exp(Q / alpha) / Z on samples of b (Sec. III-B)."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray


def importance_weights(
  q_values: Float[Array, " s *b"], alpha: Float[Array, "*b"]
) -> Float[Array, " s *b"]:
  """Returns the self-normalized importance weights softmax(Q / alpha) (Eq. 6)."""
  return jax.nn.softmax(q_values / alpha[None], axis=0)


def kl_to_prior(weights: Float[Array, " s *b"]) -> Float[Array, "*b"]:
  """Estimates KL(q || b) = sum_i w_i log(S w_i) in nats, at most log S."""
  # A weight that underflowed to zero contributes zero, not nan.
  safe = jnp.where(weights > 0.0, weights, 1.0)
  return jnp.sum(weights * jnp.log(safe), axis=0) + math.log(weights.shape[0])


def effective_sample_size(weights: Float[Array, " s *b"]) -> Float[Array, "*b"]:
  """Returns Kish's 1 / sum_i w_i^2, between 1 and S."""
  return 1.0 / jnp.sum(jnp.square(weights), axis=0)


def pick(key: PRNGKeyArray, weights: Float[Array, " s *b"]) -> Int[Array, "*b"]:
  """Draws the index of one candidate per state with probabilities ``weights``."""
  return jax.random.categorical(key, jnp.log(weights), axis=0)
