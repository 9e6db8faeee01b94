"""Mixtures from the outputs of network heads, clipped to limits."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp

from apnpql_jax.dists.gmm import GripperGMM
from apnpql_jax.types import ARM_DOF, Array


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
) -> GripperGMM:
  """Converts raw outputs of a head to a mixture around given means or its own.

  Each row of a Cholesky factor is a direction times the standard deviation of that
  joint. The deviation has a floor and a limit. Because the means are fixed, a value
  that rises towards one side can make every M-step widen the component, until most
  candidates are far from every action primitive and their values are guesses.
  Components and gripper commands keep a minimum probability, because q cannot evaluate
  actions that the prior no longer proposes. An entropy floor does not ensure this: a
  wide Gaussian compensates for a gripper that never opens.

  The limits are one-way clips, not squashing functions. In the first updates the values
  are noise, and Adam drives the outputs far to one side at a speed that does not depend
  on the gradient's size. A sigmoid or softmax never returns from there.

  Args:
    outputs: f32[*b, K * mixture_size(own_mean=primitives is None)].
    primitives: f32[*b, K, 7], means in rad/s, clipped to the action box, and logits of
      closing the gripper, to which an output is added; None if the outputs contain the
      means.
    num: components K.
    min_std: floor of the standard deviation of each joint, rad/s.
    initial_std: standard deviation for outputs of zero, rad/s.
    max_std: limit of the standard deviation of each joint, rad/s.
    min_prob: weight of a component at its floor while one of the others is at its
      limit; smallest probability of a gripper command.
    diagonal: ignore the outputs below the diagonal of the Cholesky factor.
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
  below_end = dim * (dim + 1) // 2
  log_std, below, logits, gripper = jnp.split(
    outputs, [dim, below_end, below_end + 1], axis=-1
  )
  log_std = one_way_clip(
    log_std + math.log(initial_std), math.log(min_std), math.log(max_std)
  )
  widest = 0.5 * math.log((1.0 - (num - 1) * min_prob) / min_prob)
  logits = one_way_clip(logits[..., 0], -widest, widest)
  return GripperGMM(
    logits=jax.nn.log_softmax(logits),
    loc=mean,
    scale_tril=_scale_tril(log_std, jnp.zeros_like(below) if diagonal else below),
    gripper_logits=one_way_clip(close + gripper[..., 0], -surest, surest),
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


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def one_way_clip(x: Array, low: float, high: float) -> Array:
  """Clips, with a gradient that only leads back: outward gradients are dropped.

  Args:
    x: f32[*b].
    low: lower limit.
    high: upper limit.
  """
  return jnp.clip(x, low, high)


def _forward(x: Array, low: float, high: float) -> tuple[Array, Array]:
  return jnp.clip(x, low, high), x


def _backward(low: float, high: float, x: Array, grad: Array) -> tuple[Array]:
  # Descent moves x against the gradient: a negative one pushes it up.
  outwards = ((x >= high) & (grad < 0)) | ((x <= low) & (grad > 0))
  return (jnp.where(outwards, 0.0, grad),)


one_way_clip.defvjp(_forward, _backward)
