"""The flax modules of the heads (paper Fig. 2 and Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

from flax import linen as nn
import jax.numpy as jnp
from jaxtyping import Float

from apnpql_jax.types import Array

_small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")


class MLP(nn.Module):
  """Hidden relu layers and a linear layer that starts near zero."""

  hidden: Sequence[int]
  out: int

  @nn.compact
  def __call__(self, x: Float[Array, "*b n"]) -> Float[Array, "*b out"]:
    """Applies the layers."""
    for width in self.hidden:
      x = nn.relu(nn.Dense(width)(x))
    return nn.Dense(self.out, kernel_init=_small, name="out")(x)


class Constant(nn.Module):
  """One trained number for all states, in place of an ``MLP`` with one output."""

  @nn.compact
  def __call__(self, x: Float[Array, "*b n"]) -> Float[Array, "*b 1"]:
    """Returns the number for every state."""
    value = self.param("value", nn.initializers.zeros, (1,))
    return jnp.broadcast_to(value, (*x.shape[:-1], 1))


class ValueHead(nn.Module):
  """Z_eta: values of many candidate actions per state.

  The first layer is W_phi phi + W_a a, with the larger part computed once per state.
  Candidates and states have separate axes, so that devices can divide the states.
  """

  hidden: Sequence[int]
  initial: Sequence[float]  # outputs before training, one per unit of the last layer

  @nn.compact
  def __call__(
    self, phi: Float[Array, "*b m"], actions: Float[Array, " s *b 7"]
  ) -> Float[Array, " s *b n"]:
    """Returns as many outputs per action as ``initial`` has."""
    width, *rest = self.hidden
    from_phi = nn.Dense(width, name="phi")(phi)
    centered = actions.at[..., -1].set(2.0 * actions[..., -1] - 1.0)
    x = nn.Dense(width, use_bias=False, name="action")(centered) + from_phi[None]
    x = nn.relu(x)
    for width in rest:
      x = nn.relu(nn.Dense(width)(x))
    initial = jnp.asarray(self.initial)
    return nn.Dense(
      initial.size, kernel_init=_small, bias_init=lambda *_: initial, name="out"
    )(x)


class TwinValueHeads(nn.Module):
  """Two value heads that share only phi."""

  hidden: Sequence[int]
  initial: Sequence[float]  # of the first head, then of the second

  @nn.compact
  def __call__(
    self, phi: Float[Array, "*b m"], actions: Float[Array, " s *b 7"]
  ) -> Float[Array, " s *b n"]:
    """Concatenates the outputs of both heads."""
    half = len(self.initial) // 2
    first = ValueHead(self.hidden, self.initial[:half], name="first")
    second = ValueHead(self.hidden, self.initial[half:], name="second")
    return jnp.concatenate([first(phi, actions), second(phi, actions)], axis=-1)
