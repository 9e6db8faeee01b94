"""Mixtures from the outputs of their heads, in limits they can leave again."""

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
  """Turns raw outputs of a head into a mixture, around the given means or its own.

  Each row of a Cholesky factor is a direction times the standard deviation of that
  joint. The deviation has a floor and a limit: as the means are fixed, a value that
  merely rises towards one side can make the M-step widen the component, again and
  again, until most candidates are far from every action primitive and their values
  are guesses. Components and gripper commands keep a smallest probability, for what
  the prior no longer proposes, q can neither try nor find better; an entropy floor
  cannot see to that, as a wide Gaussian makes up for a gripper that never opens.

  The limits are one-way clips and not squashing functions: in the first updates the
  values are noise, Adam drives the outputs far to one side at a speed that does not
  depend on the gradient's size, and from there a sigmoid or softmax never returns.

  Args:
    outputs: f32[*b, K * mixture_size(own_mean=primitives is None)].
    primitives: f32[*b, K, 7], means in rad/s, to be kept in the action box, and logits
      of closing the gripper, to which an output is added; None if the outputs hold the
      means.
    num: components K.
    min_std: floor of the standard deviation of each joint, rad/s.
    initial_std: the standard deviation where the outputs are zero, rad/s.
    max_std: limit of the standard deviation of each joint, rad/s.
    min_prob: weight of a component that stands at the floor while one of the others
      stands at the limit; smallest probability of a gripper command.
    diagonal: leave the outputs below the diagonal of the Cholesky factor unread.
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
    mean=mean,
    scale_tril=_scale_tril(log_std, jnp.zeros_like(below) if diagonal else below),
    gripper_logits=one_way_clip(close + gripper[..., 0], -surest, surest),
  )


def _scale_tril(log_std: Array, below: Array) -> Array:
  """Cholesky factors f32[*b, K, D, D] whose rows have the length exp(log_std)."""
  dim = log_std.shape[-1]
  rows, columns = jnp.tril_indices(dim, k=-1)
  direction = jnp.broadcast_to(jnp.eye(dim, dtype=log_std.dtype), (*log_std.shape, dim))
  direction = direction.at[..., rows, columns].set(one_way_clip(below, -1.0, 1.0))
  length = jnp.sqrt(jnp.sum(jnp.square(direction), axis=-1, keepdims=True))
  return jnp.exp(log_std)[..., None] / length * direction


def mixture_size(*, own_mean: bool) -> int:
  """Outputs per component: mean if its own, Cholesky factor, weight, gripper."""
  return ARM_DOF * own_mean + ARM_DOF * (ARM_DOF + 1) // 2 + 2


@functools.partial(jax.custom_vjp, nondiff_argnums=(1, 2))
def one_way_clip(x: Array, low: float, high: float) -> Array:
  """``clip`` with a gradient that leads back: what leads further out is dropped.

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
