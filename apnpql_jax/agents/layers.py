"""The flax modules of the heads (paper Fig. 2 and Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import functools
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from apnpql_jax.types import Array

Product = Callable[..., Array]
"""A function with the arguments of ``lax.dot_general``."""

_small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")


class MLP(nn.Module):
  """Hidden relu layers and a linear layer that starts near zero."""

  hidden: Sequence[int]
  out: int
  bias_init: nn.initializers.Initializer = nn.initializers.zeros  # of the last layer

  @nn.compact
  def __call__(self, x: Float[Array, "*b n"]) -> Float[Array, "*b out"]:
    """Applies the layers."""
    for width in self.hidden:
      x = nn.relu(nn.Dense(width)(x))
    last = nn.Dense(self.out, kernel_init=_small, bias_init=self.bias_init, name="out")
    return last(x)


class PositionwiseDense(nn.Module):
  """``nn.Dense`` for the many positions of image maps, with a faster backward pass."""

  features: int
  input_scale: float = 1.0  # factor of the inputs, applied to the kernel instead

  @nn.compact
  def __call__(self, x: Float[Array, "*b n"]) -> Float[Array, "*b features"]:
    """Applies the layer at every position."""
    shape = x.shape[-1], self.features
    kernel = self.param("kernel", nn.linear.default_kernel_init, shape)
    bias = self.param("bias", nn.initializers.zeros, (self.features,))
    return _affine(x, self.input_scale * kernel, bias)


@jax.custom_vjp
def _affine(x: Array, kernel: Array, bias: Array) -> Array:
  return x @ kernel + bias.reshape(*[1] * (x.ndim - 1), -1)


def _affine_forward(
  x: Array, kernel: Array, bias: Array
) -> tuple[Array, tuple[Array, Array]]:
  return _affine(x, kernel, bias), (x, kernel)


def _affine_backward(
  saved: tuple[Array, Array], grad: Array
) -> tuple[Array, Array, Array]:
  x, kernel = saved
  to_x = grad @ kernel.T
  # XLA:CPU would transpose a copy of the gradients for the kernel, and add up those of
  # the bias in windows. The barriers keep the product as it is written.
  x = x.reshape(-1, x.shape[-1])
  grad = jax.lax.optimization_barrier(grad.reshape(-1, grad.shape[-1]))
  over_rows = (((0,), (0,)), ((), ()))
  to_kernel = jax.lax.optimization_barrier(jax.lax.dot_general(grad, x, over_rows)).T
  to_bias = jnp.ones((1, len(grad)), grad.dtype) @ grad
  return to_x, to_kernel, to_bias[0]


_affine.defvjp(_affine_forward, _affine_backward)


class Constant(nn.Module):
  """One trained number for all states, in place of an ``MLP`` with one output."""

  @nn.compact
  def __call__(self, _: Float[Array, "*b n"]) -> Float[Array, " 1"]:
    """Returns the number."""
    return self.param("value", nn.initializers.zeros, (1,))


class ValueHead(nn.Module):
  """Z_eta: values of many candidate actions per state.

  The first layer is W_phi phi + W_a a, with the larger part computed once per state.
  Candidates and states have separate axes, so that devices can divide the states.
  """

  hidden: Sequence[int]
  initial: Sequence[float]  # outputs before training, one per unit of the last layer

  @nn.compact
  def __call__(
    self,
    phi: Float[Array, "*b m"],
    actions: Float[Array, " s *b 7"],
    *,
    product: Product | None = None,
  ) -> Float[Array, " s *b n"]:
    """Returns as many outputs per action as ``initial`` has.

    ``product`` replaces ``lax.dot_general`` in the layers after the first.
    """
    width, *rest = self.hidden
    dense = functools.partial(nn.Dense, dot_general=product)
    from_phi = nn.Dense(width, name="phi")(phi)
    centered = actions.at[..., -1].set(2.0 * actions[..., -1] - 1.0)
    x = nn.Dense(width, use_bias=False, name="action")(centered) + from_phi[None]
    x = nn.relu(x)
    for width in rest:
      x = nn.relu(dense(width)(x))
    initial = jnp.asarray(self.initial)
    return dense(
      initial.size, kernel_init=_small, bias_init=lambda *_: initial, name="out"
    )(x)


class TwinValueHeads(nn.Module):
  """Two value heads that share only phi."""

  hidden: Sequence[int]
  initial: Sequence[float]  # of the first head, then of the second

  @nn.compact
  def __call__(
    self,
    phi: Float[Array, "*b m"],
    actions: Float[Array, " s *b 7"],
    *,
    product: Product | None = None,
  ) -> Float[Array, " s *b n"]:
    """Concatenates the outputs of both heads."""
    half = len(self.initial) // 2
    first = ValueHead(self.hidden, self.initial[:half], name="first")
    second = ValueHead(self.hidden, self.initial[half:], name="second")
    outputs = [head(phi, actions, product=product) for head in (first, second)]
    return jnp.concatenate(outputs, axis=-1)


def bfloat16_product(lhs: Array, rhs: Array, *args: Any, **_: Any) -> Array:
  """Computes ``lax.dot_general`` of factors in bfloat16 with sums in float32."""
  lhs, rhs = lhs.astype(jnp.bfloat16), rhs.astype(jnp.bfloat16)
  # Fill the vectors of the CPU; a product with 51 columns would take longer.
  columns = rhs.shape[-1]
  rhs = jnp.pad(rhs, [(0, 0)] * (rhs.ndim - 1) + [(0, -columns % 16)])
  out = jax.lax.dot_general(lhs, rhs, *args, preferred_element_type=jnp.float32)
  return out[..., :columns]


PRODUCTS: dict[str, Product | None] = {"float32": None, "bfloat16": bfloat16_product}
"""Names of precisions -> products of a value head's layers after the first."""
