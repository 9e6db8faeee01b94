"""Categorical return distributions on a fixed, evenly spaced support (C51)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float
import numpy as np


def support(*, v_min: float, v_max: float, num_atoms: int) -> Float[Array, " n"]:
  """Returns the atoms: evenly spaced returns that include both ends."""
  return jnp.linspace(v_min, v_max, num_atoms, dtype=jnp.float32)


def mean(probs: Float[Array, "*b n"], atoms: Float[Array, " n"]) -> Float[Array, "*b"]:
  """Returns the expected return."""
  return probs @ atoms


def project(
  probs: Float[Array, "*b n"],
  reward: Float[Array, "*b"],
  discount: Float[Array, "*b"],
  atoms: Float[Array, " n"],
) -> Float[Array, "*b n"]:
  """Projects the distribution of ``reward + discount * z`` back onto the atoms.

  The projection is linear in ``probs``. Averaging over candidate actions first
  therefore leaves one projection per state (paper Eq. 8, right side). Atoms are evenly
  spaced and increasing. Returns beyond them count at their ends.
  """
  shape = (1,) * reward.ndim + atoms.shape
  moved = reward[..., None] + discount[..., None] * atoms.reshape(shape)
  moved = jnp.clip(moved, atoms[0], atoms[-1])
  # Atom j receives from moved atom i the share 1 - |distance| / spacing, if positive.
  distance = jnp.abs(atoms.reshape(shape + (1,)) - moved[..., None, :])
  share = jnp.maximum(1.0 - distance / (atoms[1] - atoms[0]), 0.0)
  return jnp.sum(share * probs[..., None, :], axis=-1)


def broadest_logits(
  expected: float, atoms: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
  """Returns logits of the maximum-entropy distribution of mean ``expected``.

  The logits are linear in the atoms (an exponential family); bisection finds the slope.
  """
  unit = (atoms - atoms[0]) / (atoms[-1] - atoms[0])
  goal = (expected - atoms[0]) / (atoms[-1] - atoms[0])
  low, high = -1e4, 1e4
  for _ in range(100):
    slope = 0.5 * (low + high)
    weight = np.exp(slope * unit - max(slope, 0.0))
    too_low = weight @ unit < goal * weight.sum()
    low, high = (slope, high) if too_low else (low, slope)
  return (slope * unit).astype(np.float32)
