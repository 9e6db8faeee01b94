"""A mixture over arm velocities and a gripper command: priors, parametric policies.

Each component is a full-covariance Gaussian over the continuous part of an action
times a Bernoulli over the gripper (paper Sec. IV-A). The density is therefore taken
with respect to Lebesgue x counting measure, and so is the entropy.

The triangular systems are unrolled in plain array operations: batched LAPACK calls
on thousands of 6x6 matrices are slow on XLA:CPU and can deadlock there.
"""

from __future__ import annotations

import math

from flax import struct
import jax
import jax.numpy as jnp

Array = jax.Array

_LOG_2PI = math.log(2.0 * math.pi)


class GripperGMM(struct.PyTreeNode):
  """Mixture of K components over (D continuous dimensions, one binary gripper).

  An action is ``f32[D + 1]``, the gripper in {0, 1} last. ``*b`` are batch axes.
  """

  logits: Array  # f32[*b, K]: unnormalized log weights
  mean: Array  # f32[*b, K, D]
  scale_tril: Array  # f32[*b, K, D, D]: lower Cholesky factor, positive diagonal
  gripper_logits: Array  # f32[*b, K]: log odds of gripper = 1

  def sample(self, key: Array, num: int) -> Array:
    """Draws actions; the continuous part is not clipped.

    Args:
      key: random key.
      num: samples S per batch element.

    Returns:
      f32[S, *b, D + 1].
    """
    key_arm, key_choice = jax.random.split(key)
    batch, dim, dtype = self.mean.shape[:-2], self.mean.shape[-1], self.mean.dtype
    noise = jax.random.normal(key_arm, (num, *batch, dim), dtype)
    choice = jax.random.uniform(key_choice, (2, num, *batch), dtype)
    above = jnp.cumsum(jax.nn.softmax(self.logits), axis=-1)
    component = jnp.sum(choice[0, ..., None] >= above[None, ..., :-1], axis=-1)
    chosen = jax.nn.one_hot(component, self.logits.shape[-1], dtype=dtype)
    # Moving each draw by every component and then choosing beats gathering a 6x6
    # factor per draw: K is small, and this is one batched matrix product.
    arm = jnp.einsum("...kij,s...j->s...ki", self.scale_tril, noise) + self.mean[None]
    arm = jnp.sum(chosen[..., None] * arm, axis=-2)
    probability = jnp.sum(chosen * jax.nn.sigmoid(self.gripper_logits)[None], axis=-1)
    gripper = (choice[1] < probability).astype(dtype)
    return jnp.concatenate([arm, gripper[..., None]], axis=-1)

  def log_prob(self, actions: Array) -> Array:
    """Log density of unclipped actions.

    Args:
      actions: f32[S, *b, D + 1], gripper in {0, 1} last.

    Returns:
      f32[S, *b].
    """
    arm, gripper = actions[..., :-1], actions[..., -1]
    dim = arm.shape[-1]
    # The factor is inverted once per component, not solved once per sample.
    whitener = _invert_lower(self.scale_tril)
    difference = arm[..., None, :] - self.mean[None]
    white = jnp.einsum("...kij,s...kj->s...ki", whitener, difference)
    constant = -_half_log_det(self.scale_tril) - 0.5 * dim * _LOG_2PI
    gaussian = constant[None] - 0.5 * jnp.sum(jnp.square(white), axis=-1)
    odds = self.gripper_logits[None]
    bernoulli = gripper[..., None] * odds - jax.nn.softplus(odds)
    log_weights = jax.nn.log_softmax(self.logits)[None]
    return jax.nn.logsumexp(log_weights + gaussian + bernoulli, axis=-1)

  def component_entropy(self) -> Array:
    """Entropy of each component in nats, f32[*b, K]: Gaussian plus Bernoulli."""
    dim = self.mean.shape[-1]
    gaussian = _half_log_det(self.scale_tril) + 0.5 * dim * (1.0 + _LOG_2PI)
    odds = self.gripper_logits
    return gaussian + jax.nn.softplus(odds) - odds * jax.nn.sigmoid(odds)

  def entropy_bound(self) -> Array:
    """Lower bound of the entropy in nats, from pairwise Bhattacharyya distances.

    H >= sum_i w_i H_i - sum_i w_i log sum_j w_j BC_ij (Kolchinsky and Tracey 2017,
    "Estimating Mixture Entropy with Pairwise Distances"), where the Bhattacharyya
    coefficient BC_ij of two components is the product of the Gaussian and the
    Bernoulli one. Exact for one component, for equal ones and for well separated ones.

    Returns:
      f32[*b].
    """
    log_weights = jax.nn.log_softmax(self.logits)
    log_overlap = log_weights[..., None, :] + _log_bhattacharyya(self)
    spread = -jax.nn.logsumexp(log_overlap, axis=-1)
    return jnp.sum(jnp.exp(log_weights) * (self.component_entropy() + spread), axis=-1)


def _log_bhattacharyya(gmm: GripperGMM) -> Array:
  """Log Bhattacharyya coefficients of all pairs of components, f32[*b, K, K]."""
  num = gmm.logits.shape[-1]
  rows, columns = jnp.triu_indices(num, k=1)
  scale = gmm.scale_tril
  covariance = scale @ jnp.swapaxes(scale, -1, -2)
  middle = 0.5 * (covariance[..., rows, :, :] + covariance[..., columns, :, :])
  difference = gmm.mean[..., rows, :] - gmm.mean[..., columns, :]
  half_log_det = _half_log_det(scale)
  gaussian = 0.5 * (half_log_det[..., rows] + half_log_det[..., columns])
  gaussian = gaussian + _log_overlap(middle, difference)
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


def _invert_lower(lower: Array) -> Array:
  """Inverse of lower-triangular f32[*b, D, D] by forward substitution, row by row."""
  identity = jnp.eye(lower.shape[-1], dtype=lower.dtype)
  rows: list[Array] = []
  for i in range(lower.shape[-1]):
    row = jnp.broadcast_to(identity[i], lower.shape[:-1])
    for j, known in enumerate(rows):
      row = row - lower[..., i, j, None] * known
    rows.append(row / lower[..., i, i, None])
  return jnp.stack(rows, axis=-2)


@jax.custom_vjp
def _log_overlap(matrix: Array, difference: Array) -> Array:
  """-log(det M) / 2 - d^T M^-1 d / 8 for positive definite M: f32[*b].

  The gradient is written out, as it needs nothing but the inverse.

  Args:
    matrix: f32[*b, D, D].
    difference: f32[*b, D].
  """
  return _log_overlap_forward(matrix, difference)[0]


def _log_overlap_forward(
  matrix: Array, difference: Array
) -> tuple[Array, tuple[Array, Array]]:
  inverse, log_det = _invert(matrix)
  solved = jnp.sum(inverse * difference[..., None, :], axis=-1)
  distance = jnp.sum(difference * solved, axis=-1)
  return -0.5 * log_det - 0.125 * distance, (inverse, solved)


def _log_overlap_backward(
  saved: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
  inverse, solved = saved
  outer = solved[..., :, None] * solved[..., None, :]
  to_matrix = 0.125 * outer - 0.5 * inverse
  return cotangent[..., None, None] * to_matrix, cotangent[..., None] * -0.25 * solved


_log_overlap.defvjp(_log_overlap_forward, _log_overlap_backward)


def _invert(matrix: Array) -> tuple[Array, Array]:
  """Inverse and log determinant of positive definite f32[*b, D, D].

  Sweeps one row and column after the other (Gauss-Jordan without pivoting, which
  positive definite matrices do not need); the pivots multiply to the determinant.
  """
  log_det = jnp.zeros(matrix.shape[:-2], matrix.dtype)
  for k in range(matrix.shape[-1]):
    pivot = matrix[..., k, k]
    row = matrix[..., k, :] / pivot[..., None]
    matrix = matrix - matrix[..., :, k, None] * row[..., None, :]
    matrix = matrix.at[..., k, :].set(row).at[..., :, k].set(row)
    matrix = matrix.at[..., k, k].set(-1.0 / pivot)
    log_det = log_det + jnp.log(pivot)
  return -matrix, log_det
