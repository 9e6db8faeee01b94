"""The flax modules behind the heads (paper Fig. 2 and Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

from flax import linen as nn
import jax.numpy as jnp

from apnpql_jax.types import Array

_small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")


class Head(nn.Module):
  """Hidden relu layers and a linear layer that starts near zero."""

  hidden: Sequence[int]
  out: int

  @nn.compact
  def __call__(self, x: Array) -> Array:
    """f32[*b, n] -> f32[*b, out]."""
    for width in self.hidden:
      x = nn.relu(nn.Dense(width)(x))
    return nn.Dense(self.out, kernel_init=_small, name="out")(x)


class Constant(nn.Module):
  """One trained number for all states, in the place of a ``Head`` with one output."""

  @nn.compact
  def __call__(self, x: Array) -> Array:
    """f32[*b, n] -> f32[*b, 1]."""
    value = self.param("value", nn.initializers.zeros, (1,))
    return jnp.broadcast_to(value, (*x.shape[:-1], 1))


class ValueHead(nn.Module):
  """Z_eta: values of many candidate actions of one state.

  The first layer is W_phi phi + W_a a; the large half is computed once per state.
  Candidates and states stay apart, so that devices can divide the states.
  """

  hidden: Sequence[int]
  initial: Sequence[float]
  """Outputs before training, one per unit of the last layer."""

  @nn.compact
  def __call__(self, phi: Array, actions: Array) -> Array:
    """phi f32[*b, n], actions f32[S, *b, 7] -> f32[S, *b, len(initial)]."""
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
  """Two value heads that share nothing but phi; their outputs stand side by side."""

  hidden: Sequence[int]
  initial: Sequence[float]
  """Outputs before training, those of the first head, then those of the second."""

  @nn.compact
  def __call__(self, phi: Array, actions: Array) -> Array:
    """phi f32[*b, n], actions f32[S, *b, 7] -> f32[S, *b, len(initial)]."""
    half = len(self.initial) // 2
    heads = (
      ValueHead(self.hidden, self.initial[:half], name="first"),
      ValueHead(self.hidden, self.initial[half:], name="second"),
    )
    return jnp.concatenate([head(phi, actions) for head in heads], axis=-1)
