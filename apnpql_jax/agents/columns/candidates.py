"""Candidate actions and the weights that a policy puts on them."""

from __future__ import annotations

import math

from flax import struct
import jax
import jax.numpy as jnp

from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


class Candidates(struct.PyTreeNode):
  """S candidate actions per state and the policy's weights on them."""

  samples: Array  # f32[S, *b, 7]: as drawn, where densities are evaluated
  actions: Array  # f32[S, *b, 7]: clipped to the action box, where Q is evaluated
  outputs: Array  # f32[S, *b, n]: of the value head
  q_values: Array  # f32[S, *b]
  weights: Array  # f32[S, *b]: sum to one over S
  base: ActionDistribution  # [*b]: the policy is base exp(tilt Q), normalized
  tilt: Array  # f32[*b]: 1 / alpha, or zero where the policy is ``base`` itself

  @property
  def value(self) -> Array:
    """E[Q] under the policy, f32[*b]."""
    return jnp.sum(self.weights * self.q_values, axis=0)

  @property
  def entropy(self) -> Array:
    """Estimate of the policy's entropy in nats, f32[*b]."""
    surprise = -self.log_prob(self.samples, self.q_values)
    return jnp.sum(self.weights * surprise, axis=0)

  def log_prob(self, actions: Array, q_values: Array) -> Array:
    """Log density of actions f32[T, *b, 7] with values f32[T, *b]: f32[T, *b].

    Of q it is an estimate: log b + Q / alpha - log mean_i exp(Q_i / alpha).
    """
    tilt = self.tilt[None]
    log_sum = jax.nn.logsumexp(tilt * self.q_values, axis=0, keepdims=True)
    log_mean = log_sum - math.log(self.q_values.shape[0])
    return self.base.log_prob(actions) + tilt * q_values - log_mean


def clip_action(actions: Array) -> Array:
  """Limits joint velocities to [-1, 1] rad/s; the gripper, in {0, 1}, is unchanged."""
  return jnp.clip(actions, -1.0, 1.0)
