"""What every distribution over actions can do, and the broadest one on the box."""

from __future__ import annotations

import math
from typing import Protocol

from flax import struct
import jax
import jax.numpy as jnp

Array = jax.Array


class ActionDistribution(Protocol):
  """Distribution over actions f32[D + 1], the gripper in {0, 1} last, batch ``*b``.

  Densities are with respect to Lebesgue x counting measure, and so are entropies.
  """

  def sample(self, key: Array, num: int) -> Array:
    """Draws f32[num, *b, D + 1]."""
    ...

  def log_prob(self, actions: Array) -> Array:
    """Log density: f32[S, *b, D + 1] -> f32[S, *b]."""
    ...

  def entropy_bound(self) -> Array:
    """The entropy in nats or a lower bound of it, f32[*b]."""
    ...


class UniformBox(struct.PyTreeNode):
  """Uniform over [-1, 1]^D x {0, 1}: what regularizes plain entropy maximization.

  The density is the same everywhere, beyond the box too: an action drawn out there
  is clipped to the box before anything sees it. KL(pi || uniform) is then
  log_volume - H(pi).
  """

  batch: tuple[int, ...] = struct.field(pytree_node=False)
  dim: int = struct.field(pytree_node=False)

  @property
  def log_volume(self) -> float:
    """Entropy in nats: D log 2 for the arm, log 2 for the gripper."""
    return (self.dim + 1) * math.log(2.0)

  def sample(self, key: Array, num: int) -> Array:
    """Draws f32[num, *b, D + 1]."""
    draws = jax.random.uniform(
      key, (num, *self.batch, self.dim + 1), jnp.float32, minval=-1.0
    )
    gripper = (draws[..., -1:] > 0.0).astype(draws.dtype)
    return jnp.concatenate([draws[..., :-1], gripper], axis=-1)

  def log_prob(self, actions: Array) -> Array:
    """-log_volume, f32[S, *b]."""
    return jnp.full(actions.shape[:-1], -self.log_volume, actions.dtype)

  def entropy_bound(self) -> Array:
    """log_volume, exactly: f32[*b]."""
    return jnp.full(self.batch, self.log_volume, jnp.float32)
