"""Candidate actions and the weights that a policy puts on them."""

from __future__ import annotations

import math

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Float

from apnpql_jax.agents.networks import Heads
from apnpql_jax.dists.action import ActionDistribution
from apnpql_jax.types import Array


class Candidates(struct.PyTreeNode):
  """S candidate actions per state and the policy's weights on them."""

  samples: Float[Array, " s *b 7"]  # as drawn, where densities are evaluated
  actions: Float[Array, " s *b 7"]  # clipped to the action box, where Q is evaluated
  outputs: Float[Array, " s *b n"]  # of the value head
  q_values: Float[Array, " s *b"]
  weights: Float[Array, " s *b"]  # sum to one over S
  base: ActionDistribution  # [*b]; the policy is base exp(tilt Q), normalized
  tilt: Float[Array, "*b"]  # 1 / alpha, or zero where the policy is ``base`` itself

  @property
  def value(self) -> Float[Array, "*b"]:
    """E[Q] under the policy."""
    return jnp.sum(self.weights * self.q_values, axis=0)

  @property
  def entropy(self) -> Float[Array, "*b"]:
    """Estimate of the policy's entropy in nats."""
    return jnp.sum(self.weights * -self.log_prob(self.samples, self.q_values), axis=0)

  def log_prob(
    self, actions: Float[Array, " t *b 7"], q_values: Float[Array, " t *b"]
  ) -> Float[Array, " t *b"]:
    """Returns log densities; for q, log b + Q / alpha - log mean_i exp(Q_i / alpha)."""
    tilt = self.tilt[None]
    log_sum = jax.nn.logsumexp(tilt * self.q_values, axis=0, keepdims=True)
    log_mean = log_sum - math.log(self.q_values.shape[0])
    return self.base.log_prob(actions) + tilt * q_values - log_mean


def clip_action(actions: Float[Array, "*b 7"]) -> Float[Array, "*b 7"]:
  """Clips joint velocities to [-1, 1] rad/s; leaves the gripper in {0, 1} unchanged."""
  return jnp.clip(actions, -1.0, 1.0)


def with_either_gripper(arm: Float[Array, " s *b 6"]) -> Float[Array, " 2*s *b 7"]:
  """Pairs each arm action with both gripper commands, first all that open."""
  command = jnp.zeros_like(arm[..., :1])
  return jnp.concatenate(
    [jnp.concatenate([arm, command + close], axis=-1) for close in (0.0, 1.0)]
  )


def score(
  heads: Heads, samples: Float[Array, " s *b 7"]
) -> tuple[Float[Array, " s *b 7"], Float[Array, " s *b n"], Float[Array, " s *b"]]:
  """Returns clipped actions, the outputs of the value head, and Q."""
  actions = clip_action(samples)
  outputs = heads.z(actions, precision=heads.config.candidate_precision)
  return actions, outputs, heads.networks.value(outputs)


def all_on_the_highest(x: Float[Array, " s *b"]) -> Float[Array, " s *b"]:
  """Returns weights that select the highest score over S."""
  return jax.nn.one_hot(jnp.argmax(x, axis=0), x.shape[0], axis=0, dtype=x.dtype)
