"""Categorical return distributions on a fixed, evenly spaced support (C51)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array


def support(*, v_min: float, v_max: float, num_atoms: int) -> Array:
  """The returns the atoms stand for, f32[n], evenly spaced with both ends."""
  return jnp.linspace(v_min, v_max, num_atoms, dtype=jnp.float32)


def mean(probs: Array, atoms: Array) -> Array:
  """Expected return of f32[*b, n] probabilities on f32[n] atoms: f32[*b]."""
  return probs @ atoms


def project(probs: Array, reward: Array, discount: Array, atoms: Array) -> Array:
  """Projects the distribution of ``reward + discount * z`` back onto the atoms.

  The projection is linear in ``probs``. So the expectation over candidate actions
  is taken first, and one projection per state is enough (paper Eq. 8, right side).

  Args:
    probs: f32[*b, n] distribution of the return z at the bootstrap state, already
      averaged over actions.
    reward: f32[*b].
    discount: f32[*b], zero where the episode terminated.
    atoms: f32[n], evenly spaced and increasing.

  Returns:
    f32[*b, n], same mass as ``probs``; returns beyond the support go to its ends.
  """
  shape = (1,) * reward.ndim + atoms.shape
  moved = reward[..., None] + discount[..., None] * atoms.reshape(shape)
  moved = jnp.clip(moved, atoms[0], atoms[-1])
  # Atom j receives from moved atom i the share 1 - |distance| / spacing, if positive.
  distance = jnp.abs(atoms.reshape(shape + (1,)) - moved[..., None, :])
  share = jnp.maximum(1.0 - distance / (atoms[1] - atoms[0]), 0.0)
  return jnp.sum(share * probs[..., None, :], axis=-1)


def cross_entropy(probs: Array, logits: Array) -> Array:
  """-sum_j p_j log softmax(logits)_j over the last axis: f32[*b, n] -> f32[*b]."""
  return -jnp.sum(probs * jax.nn.log_softmax(logits), axis=-1)


def broadest_logits(expected: float, atoms: np.ndarray) -> np.ndarray:
  """Logits f32[n] of the maximum-entropy distribution with a given mean.

  They are linear in the atoms (an exponential family); the slope is found by
  bisection. ``expected`` must lie strictly between the ends of ``atoms``.
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
