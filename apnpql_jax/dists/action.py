"""Distributions over actions: their interface and the uniform one on the action box.

In shapes, ``*b`` are batch axes, ``*sb`` sample axes before them, ``d`` joints.
"""

from __future__ import annotations

import abc
import math

import distrax
from flax import struct
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class ActionDistribution(
  distrax.Distribution[Array, tuple[int, ...], jnp.dtype], struct.PyTreeNode
):
  """Distribution over actions f32[D + 1] with the gripper command in {0, 1} last.

  Densities and entropies refer to the product of Lebesgue and counting measure.
  """

  @abc.abstractmethod
  def log_prob(self, value: Float[Array, "*sb d+1"]) -> Float[Array, "*sb"]:
    """Returns the log density of actions that need not lie in the action box."""

  @abc.abstractmethod
  def entropy_bound(self) -> Float[Array, "*b"]:
    """Returns a lower bound of the entropy in nats."""


class UniformBox(ActionDistribution):
  """Uniform distribution over [-1, 1]^D x {0, 1}, the regularizer of plain entropy.

  The density is the same outside the box, because actions are clipped before use.
  """

  batch: tuple[int, ...] = struct.field(pytree_node=False)
  dim: int = struct.field(pytree_node=False)

  @property
  def event_shape(self) -> tuple[int, ...]:
    """Shape of one action."""
    return (self.dim + 1,)

  @property
  def log_volume(self) -> float:
    """Entropy in nats: D log 2 for the arm and log 2 for the gripper."""
    return (self.dim + 1) * math.log(2.0)

  def _sample_n(self, key: PRNGKeyArray, n: int) -> Float[Array, "n *b d+1"]:
    cube = distrax.Uniform(jnp.full((*self.batch, *self.event_shape), -1.0), 1.0)
    draws = cube.sample(seed=key, sample_shape=n)
    gripper = (draws[..., -1:] > 0.0).astype(draws.dtype)
    return jnp.concatenate([draws[..., :-1], gripper], axis=-1)

  def log_prob(self, value: Float[Array, "*sb d+1"]) -> Float[Array, "*sb"]:
    """Returns -log_volume for every action, also for those outside the box."""
    return jnp.full(value.shape[:-1], -self.log_volume, value.dtype)

  def entropy(self) -> Float[Array, "*b"]:
    """Returns log_volume for every batch element."""
    return jnp.full(self.batch, self.log_volume, jnp.float32)

  def entropy_bound(self) -> Float[Array, "*b"]:
    """Returns the entropy, which is known exactly."""
    return self.entropy()
