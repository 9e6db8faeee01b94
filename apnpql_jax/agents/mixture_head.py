"""Mixtures from the outputs of network heads, clipped to limits."""

from __future__ import annotations

import functools
import math

from flax import linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ARM_DOF, Array

_SPREAD = 0.3  # rad/s; deviation of each joint's first mean between components


def mixture_from_outputs(
  outputs: Array,
  primitives: Array | None,
  *,
  num: int,
  min_std: float,
  initial_std: float,
  max_std: float,
  min_prob: float,
  diagonal: bool = False,
  gripper_offset: bool = True,
) -> GripperGMM:
  """Converts raw outputs of a head to a mixture of ``num`` components.

  The means are ``primitives`` f32[*b, K, 7], clipped to the action box, with logits of
  closing the gripper to which an output is added, unless ``gripper_offset`` is false.
  Without ``primitives``, outputs hold the means.

  Each row of a Cholesky factor is a direction times the standard deviation of that
  joint (rad/s), ``initial_std`` for outputs of zero. One-way clips limit standard
  deviations, gripper probabilities and weights; see the decision "One-way clips in the
  prior" in ``docs/decisions/learning.md``.
  """
  dim = ARM_DOF
  outputs = outputs.reshape(*outputs.shape[:-1], num, -1)
  surest = math.log((1.0 - min_prob) / min_prob)
  if primitives is None:
    mean, outputs = one_way_clip(outputs[..., :dim], -1.0, 1.0), outputs[..., dim:]
    close = jnp.zeros(outputs.shape[:-1])
  else:
    mean = jnp.clip(primitives[..., :dim], -1.0, 1.0)
    close = jnp.clip(primitives[..., dim], -surest, surest)
  end = dim * (dim + 1) // 2
  log_std, below, logits, gripper = jnp.split(outputs, [dim, end, end + 1], axis=-1)
  if gripper_offset:
    close = one_way_clip(close + gripper[..., 0], -surest, surest)
  log_std = log_std + math.log(initial_std)
  log_std = one_way_clip(log_std, math.log(min_std), math.log(max_std))
  widest = 0.5 * math.log((1.0 - (num - 1) * min_prob) / min_prob)
  logits = one_way_clip(logits[..., 0], -widest, widest)
  return GripperGMM(
    logits=jax.nn.log_softmax(logits),
    loc=mean,
    scale_tril=_scale_tril(log_std, jnp.zeros_like(below) if diagonal else below),
    gripper_logits=close,
  )


def _scale_tril(log_std: Array, below: Array) -> Array:
  """Returns Cholesky factors f32[*b, K, D, D] with rows of length exp(log_std)."""
  dim = log_std.shape[-1]
  rows, columns = jnp.tril_indices(dim, k=-1)
  direction = jnp.broadcast_to(jnp.eye(dim, dtype=log_std.dtype), (*log_std.shape, dim))
  direction = direction.at[..., rows, columns].set(one_way_clip(below, -1.0, 1.0))
  length = jnp.sqrt(jnp.sum(jnp.square(direction), axis=-1, keepdims=True))
  return jnp.exp(log_std)[..., None] / length * direction


def mixture_size(*, own_mean: bool) -> int:
  """Counts outputs per component: own mean, Cholesky factor, weight and gripper."""
  return ARM_DOF * own_mean + ARM_DOF * (ARM_DOF + 1) // 2 + 2


def spread_means(num: int) -> nn.initializers.Initializer:
  """Returns the bias initializer of a head with its own means; several start apart.

  Components that start together have nearly equal gradients, so only noise would
  separate them.
  """

  def init(key: PRNGKeyArray, shape: tuple[int, ...], dtype: jnp.dtype) -> Array:
    bias = jnp.zeros((num, shape[0] // num), dtype)
    if num > 1:
      means = _SPREAD * jax.random.normal(key, (num, ARM_DOF), dtype)
      bias = bias.at[:, :ARM_DOF].set(means)
    return bias.reshape(shape)

  return init


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def one_way_clip(x: Array, low: float, high: float) -> Array:
  """Clips, with a gradient that only leads back: outward gradients are dropped."""
  return jnp.clip(x, low, high)


def _forward(x: Array, low: float, high: float) -> tuple[Array, Array]:
  return jnp.clip(x, low, high), x


def _backward(low: float, high: float, x: Array, grad: Array) -> tuple[Array]:
  # Descent moves x against the gradient: a negative one pushes it up.
  outward = ((x >= high) & (grad < 0)) | ((x <= low) & (grad > 0))
  return (jnp.where(outward, 0.0, grad),)


one_way_clip.defvjp(_forward, _backward)
