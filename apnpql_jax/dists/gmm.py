"""The behaviour prior: a mixture over arm velocities and a gripper command.

Each component is a full-covariance Gaussian over the continuous part of an action
times a Bernoulli over the gripper (paper Sec. IV-A). The density is therefore taken
with respect to Lebesgue x counting measure, and so is the entropy.

The triangular systems are unrolled in plain array operations: batched LAPACK calls
on thousands of 6x6 matrices are slow on XLA:CPU and can deadlock there.
"""

from __future__ import annotations

import math

import distrax
from flax import struct
import jax
import jax.numpy as jnp

Array = jax.Array

_LOG_2PI = math.log(2.0 * math.pi)


@struct.dataclass
class GripperGMM:
  """Mixture of K components over (D continuous dimensions, one binary gripper).

  An action is ``f32[D + 1]``, the gripper in {0, 1} last. ``*b`` are batch axes.
  """

  logits: Array  # f32[*b, K]: unnormalised log weights
  mean: Array  # f32[*b, K, D]
  scale_tril: Array  # f32[*b, K, D, D]: lower Cholesky factor, positive diagonal
  gripper_logits: Array  # f32[*b, K]: log odds of gripper = 1


def sample(key: Array, gmm: GripperGMM, num: int) -> Array:
  """Draws actions; the continuous part is not clipped.

  Args:
    key: random key.
    gmm: the mixture, batch ``*b``.
    num: samples S per batch element.

  Returns:
    f32[S, *b, D + 1].
  """
  key_component, key_arm, key_gripper = jax.random.split(key, 3)
  batch, dim = gmm.mean.shape[:-2], gmm.mean.shape[-1]
  component = distrax.OneHotCategorical(logits=gmm.logits, dtype=gmm.mean.dtype)
  chosen = component.sample(seed=key_component, sample_shape=(num,))
  noise = jax.random.normal(key_arm, (num, *batch, dim), gmm.mean.dtype)
  # Moving each draw by every component and then choosing beats gathering a 6x6
  # factor per draw: K is small, and this is one batched matrix product.
  arm = jnp.einsum("...kij,s...j->s...ki", gmm.scale_tril, noise) + gmm.mean[None]
  arm = jnp.sum(chosen[..., None] * arm, axis=-2)
  probability = jnp.sum(chosen * jax.nn.sigmoid(gmm.gripper_logits)[None], axis=-1)
  gripper = jax.random.bernoulli(key_gripper, probability).astype(arm.dtype)
  return jnp.concatenate([arm, gripper[..., None]], axis=-1)


def log_prob(gmm: GripperGMM, actions: Array) -> Array:
  """Log density of unclipped actions.

  Args:
    gmm: the mixture, batch ``*b``.
    actions: f32[S, *b, D + 1], gripper in {0, 1} last.

  Returns:
    f32[S, *b].
  """
  arm, gripper = actions[..., :-1], actions[..., -1]
  dim = arm.shape[-1]
  # The factor is inverted once per component, not solved once per sample.
  whitener = _solve_lower(gmm.scale_tril, jnp.eye(dim, dtype=arm.dtype))
  difference = arm[..., None, :] - gmm.mean[None]
  white = jnp.einsum("...kij,s...kj->s...ki", whitener, difference)
  constant = -_half_log_det(gmm.scale_tril) - 0.5 * dim * _LOG_2PI
  gaussian = constant[None] - 0.5 * jnp.sum(jnp.square(white), axis=-1)
  odds = gmm.gripper_logits[None]
  bernoulli = gripper[..., None] * odds - jax.nn.softplus(odds)
  log_weights = jax.nn.log_softmax(gmm.logits)[None]
  return jax.nn.logsumexp(log_weights + gaussian + bernoulli, axis=-1)


def component_entropy(gmm: GripperGMM) -> Array:
  """Entropy of each component in nats, f32[*b, K]: Gaussian plus Bernoulli."""
  dim = gmm.mean.shape[-1]
  gaussian = _half_log_det(gmm.scale_tril) + 0.5 * dim * (1.0 + _LOG_2PI)
  odds = gmm.gripper_logits
  return gaussian + jax.nn.softplus(odds) - odds * jax.nn.sigmoid(odds)


def entropy_bound(gmm: GripperGMM) -> Array:
  """Lower bound of the entropy in nats, from pairwise Bhattacharyya distances.

  H >= sum_i w_i H_i - sum_i w_i log sum_j w_j BC_ij (Kolchinsky and Tracey 2017,
  "Estimating Mixture Entropy with Pairwise Distances"), where the Bhattacharyya
  coefficient BC_ij of two components is the product of the Gaussian and the
  Bernoulli one. Exact for one component, for equal ones and for well separated ones.

  Returns:
    f32[*b].
  """
  log_weights = jax.nn.log_softmax(gmm.logits)
  log_overlap = log_weights[..., None, :] + _log_bhattacharyya(gmm)
  spread = -jax.nn.logsumexp(log_overlap, axis=-1)
  return jnp.sum(jnp.exp(log_weights) * (component_entropy(gmm) + spread), axis=-1)


def _log_bhattacharyya(gmm: GripperGMM) -> Array:
  """Log Bhattacharyya coefficients of all pairs of components, f32[*b, K, K]."""
  num = gmm.logits.shape[-1]
  rows, columns = jnp.triu_indices(num, k=1)
  scale = gmm.scale_tril
  covariance = scale @ jnp.swapaxes(scale, -1, -2)
  middle = _cholesky(
    0.5 * (covariance[..., rows, :, :] + covariance[..., columns, :, :])
  )
  difference = gmm.mean[..., rows, :] - gmm.mean[..., columns, :]
  white = _solve_lower(middle, difference[..., None])[..., 0]
  half_log_det = _half_log_det(scale)
  gaussian = (
    0.5 * (half_log_det[..., rows] + half_log_det[..., columns])
    - _half_log_det(middle)
    - 0.125 * jnp.sum(jnp.square(white), axis=-1)
  )
  one, zero = (jax.nn.log_sigmoid(s * gmm.gripper_logits) for s in (1.0, -1.0))
  bernoulli = jnp.logaddexp(
    0.5 * (one[..., rows] + one[..., columns]),
    0.5 * (zero[..., rows] + zero[..., columns]),
  )
  upper = jnp.zeros(covariance.shape[:-2] + (num,), scale.dtype)
  upper = upper.at[..., rows, columns].set(gaussian + bernoulli)
  return upper + jnp.swapaxes(upper, -1, -2)


def _half_log_det(scale_tril: Array) -> Array:
  """Half the log determinant of L L^T, for L of f32[..., D, D]."""
  diagonal = jnp.diagonal(scale_tril, axis1=-2, axis2=-1)
  return jnp.sum(jnp.log(diagonal), axis=-1)


def _solve_lower(lower: Array, rhs: Array) -> Array:
  """X of L X = B by forward substitution, one row of X at a time.

  Args:
    lower: f32[*b, D, D], lower triangular.
    rhs: f32[*b, D, M], or f32[D, M] for the same right-hand side everywhere.

  Returns:
    f32[*b, D, M].
  """
  rhs = jnp.broadcast_to(rhs, lower.shape[:-1] + rhs.shape[-1:])
  rows: list[Array] = []
  for i in range(lower.shape[-1]):
    row = rhs[..., i, :]
    for j, known in enumerate(rows):
      row = row - lower[..., i, j, None] * known
    rows.append(row / lower[..., i, i, None])
  return jnp.stack(rows, axis=-2)


def _cholesky(matrix: Array) -> Array:
  """Lower Cholesky factor of f32[*b, D, D], one column at a time."""
  dim = matrix.shape[-1]
  columns: list[Array] = []
  for j in range(dim):
    column = matrix[..., :, j]
    for known in columns:
      column = column - known * known[..., j, None]
    below = (jnp.arange(dim) >= j).astype(matrix.dtype)
    below = jnp.broadcast_to(below, column.shape)
    columns.append(below * column / jnp.sqrt(column[..., j, None]))
  return jnp.stack(columns, axis=-1)
