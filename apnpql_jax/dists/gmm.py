"""Gaussian mixtures over arm velocities with a gripper command per component.

Behavior priors and parametric policies are such mixtures. Each component is a
full-covariance Gaussian times a Bernoulli over the gripper (paper Sec. IV-A). Shapes
are written as in ``action``, with ``k`` for the components.

Samples and densities are plain array operations. distrax's samplers draw noise for
every component although only one is used. Its triangular normal makes batched LAPACK
calls, which are slow for thousands of 6x6 matrices on XLA:CPU and can deadlock there.
"""

from __future__ import annotations

import math

import distrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from apnpql_jax.dists.action import ActionDistribution

_LOG_2PI = math.log(2.0 * math.pi)


class GripperGMM(ActionDistribution):
  """Mixture of K components over D continuous dimensions and one binary gripper."""

  logits: Float[Array, "*b k"]  # log weights, not necessarily normalized
  loc: Float[Array, "*b k d"]  # means of the continuous part
  scale_tril: Float[Array, "*b k d d"]  # Cholesky factors with positive diagonals
  gripper_logits: Float[Array, "*b k"]  # log odds of gripper = 1

  @property
  def event_shape(self) -> tuple[int, ...]:
    """Shape of one action."""
    return (self.loc.shape[-1] + 1,)

  @property
  def choice(self) -> distrax.Categorical:
    """Distribution of the component."""
    return distrax.Categorical(logits=self.logits)

  @property
  def gripper(self) -> distrax.Bernoulli:
    """Distribution of the gripper command, given the component."""
    return distrax.Bernoulli(logits=self.gripper_logits)

  def _sample_n(self, key: PRNGKeyArray, n: int) -> Float[Array, "n *b d+1"]:
    key_arm, key_choice = jax.random.split(key)
    batch, dim, dtype = self.loc.shape[:-2], self.loc.shape[-1], self.loc.dtype
    # Until the end, draws are behind the batch, as batched matrix products want them.
    noise = jax.random.normal(key_arm, (*batch, n, dim), dtype)
    uniform = jax.random.uniform(key_choice, (2, *batch, n), dtype)
    # Choose components by inverting the cumulative distribution.
    above = jnp.cumsum(jax.nn.softmax(self.logits), axis=-1)[..., None, :]
    component = jnp.sum(uniform[0, ..., None] >= above[..., :-1], axis=-1)
    chosen = jax.nn.one_hot(component, self.logits.shape[-1], dtype=dtype)
    # Transform each draw by every component, then choose: with few components, one
    # batched matrix product is faster than gathering a 6x6 factor per draw.
    arm = jnp.einsum("...kij,...sj->...ski", self.scale_tril, noise)
    arm = jnp.sum(chosen[..., None] * (arm + self.loc[..., None, :, :]), axis=-2)
    probability = jnp.sum(
      chosen * jnp.asarray(self.gripper.probs)[..., None, :], axis=-1
    )
    gripper = (uniform[1] < probability).astype(dtype)
    return jnp.moveaxis(jnp.concatenate([arm, gripper[..., None]], axis=-1), -2, 0)

  def sample_each(self, key: PRNGKeyArray, n: int) -> Float[Array, "n k *b d"]:
    """Draws the continuous part n times from every component.

    One component draws what ``sample`` draws with the same key.
    """
    shape = (*self.loc.shape[:-1], n, self.loc.shape[-1])
    noise = jax.random.normal(jax.random.split(key)[0], shape, self.loc.dtype)
    arm = jnp.einsum("...kij,...ksj->...ski", self.scale_tril, noise)
    return jnp.moveaxis(arm + self.loc[..., None, :, :], (-3, -2), (0, 1))

  def log_prob(self, value: Float[Array, "*sb d+1"]) -> Float[Array, "*sb"]:
    """Returns the log density of unclipped actions."""
    total = jax.nn.logsumexp(self._log_joint(value), axis=-2)
    return self._samples_first(total, value)

  def responsibilities(self, value: Float[Array, "*sb d+1"]) -> Float[Array, "*sb k"]:
    """Returns the probability that each component drew the unclipped actions."""
    shares = jax.nn.softmax(self._log_joint(value), axis=-2)
    shares = [self._samples_first(x, value) for x in jnp.moveaxis(shares, -2, 0)]
    return jnp.stack(shares, axis=-1)

  def _log_joint(self, value: Float[Array, "*sb d+1"]) -> Float[Array, "*b k n"]:
    """Returns log weight plus log density of each component at each of n samples."""
    batch = self.logits.shape[:-1]
    # Move the samples behind the batch, as batched matrix products want them.
    samples = jnp.moveaxis(value.reshape(-1, *batch, value.shape[-1]), 0, -2)
    arm, gripper = samples[..., None, :, :-1], samples[..., None, :, -1]
    # Invert the factor once per component instead of solving once per sample.
    whitener = _invert_lower(self.scale_tril)
    white = jnp.einsum("...ij,...sj->...si", whitener, arm - self.loc[..., None, :])
    constant = -_half_log_det(self.scale_tril) - 0.5 * arm.shape[-1] * _LOG_2PI
    gaussian = constant[..., None] - 0.5 * jnp.sum(jnp.square(white), axis=-1)
    odds = self.gripper_logits[..., None]
    bernoulli = gripper * odds - jax.nn.softplus(odds)
    log_weights = jnp.asarray(self.choice.logits)[..., None]
    return log_weights + gaussian + bernoulli

  def _samples_first(
    self, x: Float[Array, "*b n"], value: Float[Array, "*sb d+1"]
  ) -> Float[Array, "*sb"]:
    """Moves the n samples of ``value`` back before the batch."""
    return jnp.moveaxis(x, -1, 0).reshape(value.shape[:-1])

  def component_entropy(self) -> Float[Array, "*b k"]:
    """Returns the entropy of each component in nats: Gaussian plus Bernoulli."""
    dim = self.loc.shape[-1]
    gaussian = _half_log_det(self.scale_tril) + 0.5 * dim * (1.0 + _LOG_2PI)
    odds = self.gripper_logits
    return gaussian + jax.nn.softplus(odds) - odds * self.gripper.probs

  def entropy_bound(self) -> Float[Array, "*b"]:
    """Returns a lower bound of the entropy in nats.

    H >= sum_i w_i H_i - sum_i w_i log sum_j w_j BC_ij (Kolchinsky and Tracey 2017,
    "Estimating Mixture Entropy with Pairwise Distances"), where the Bhattacharyya
    coefficient BC_ij of two components is the product of the Gaussian and the
    Bernoulli one. The bound is exact for one, for equal and for distant components.
    """
    log_weights = jnp.asarray(self.choice.logits)
    log_overlap = log_weights[..., None, :] + _log_bhattacharyya(self)
    spread = -jax.nn.logsumexp(log_overlap, axis=-1)
    return jnp.sum(jnp.exp(log_weights) * (self.component_entropy() + spread), axis=-1)


def _log_bhattacharyya(gmm: GripperGMM) -> Float[Array, "*b k k"]:
  """Returns the log Bhattacharyya coefficients of all pairs of components."""
  num = gmm.logits.shape[-1]
  rows, columns = jnp.triu_indices(num, k=1)
  scale = gmm.scale_tril
  covariance = scale @ jnp.swapaxes(scale, -1, -2)
  middle = 0.5 * (covariance[..., rows, :, :] + covariance[..., columns, :, :])
  difference = gmm.loc[..., rows, :] - gmm.loc[..., columns, :]
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


def _half_log_det(scale_tril: Float[Array, "*b d d"]) -> Float[Array, "*b"]:
  """Returns half the log determinant of L L^T."""
  return jnp.sum(jnp.log(jnp.diagonal(scale_tril, axis1=-2, axis2=-1)), axis=-1)


def _invert_lower(lower: Float[Array, "*b d d"]) -> Float[Array, "*b d d"]:
  """Inverts lower-triangular matrices by forward substitution, row by row."""
  identity = jnp.eye(lower.shape[-1], dtype=lower.dtype)
  rows: list[Float[Array, "*b d"]] = []
  for i in range(lower.shape[-1]):
    row = jnp.broadcast_to(identity[i], lower.shape[:-1])
    for j, known in enumerate(rows):
      row = row - lower[..., i, j, None] * known
    rows.append(row / lower[..., i, i, None])
  return jnp.stack(rows, axis=-2)


_MatrixVector = tuple[Float[Array, "*b d d"], Float[Array, "*b d"]]


@jax.custom_vjp
def _log_overlap(
  matrix: Float[Array, "*b d d"], difference: Float[Array, "*b d"]
) -> Float[Array, "*b"]:
  """Returns -log(det M) / 2 - x^T M^-1 x / 8; the gradient needs only the inverse."""
  return _log_overlap_forward(matrix, difference)[0]


def _log_overlap_forward(
  matrix: Float[Array, "*b d d"], difference: Float[Array, "*b d"]
) -> tuple[Float[Array, "*b"], _MatrixVector]:
  inverse, log_det = _invert(matrix)
  solved = jnp.sum(inverse * difference[..., None, :], axis=-1)
  distance = jnp.sum(difference * solved, axis=-1)
  return -0.5 * log_det - 0.125 * distance, (inverse, solved)


def _log_overlap_backward(
  saved: _MatrixVector, cotangent: Float[Array, "*b"]
) -> _MatrixVector:
  inverse, solved = saved
  outer = solved[..., :, None] * solved[..., None, :]
  to_matrix = 0.125 * outer - 0.5 * inverse
  return cotangent[..., None, None] * to_matrix, cotangent[..., None] * -0.25 * solved


_log_overlap.defvjp(_log_overlap_forward, _log_overlap_backward)


def _invert(
  matrix: Float[Array, "*b d d"],
) -> tuple[Float[Array, "*b d d"], Float[Array, "*b"]]:
  """Returns the inverse and the log determinant of positive definite matrices.

  Sweeps rows and columns in order: Gauss-Jordan, which needs no pivoting here.
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
