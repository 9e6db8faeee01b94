"""Random transitions for tests of the learner, and a learner small enough for them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import Observation, Slot, TimeStep, Transition

SMALL = AgentConfig(
  hidden=(16, 16),
  feature_dim=16,
  num_atoms=11,
  target_samples=8,
  policy_samples=8,
  patch_channels=4,
  conv_channels=4,
  n_step=2,
)
"""Compiles in a few seconds, whichever row of Table I it is given."""


def random_batch(
  seed: int,
  batch: int = 16,
  *,
  pixels: bool = False,
  windows: int = 0,
  instants: int = 0,
) -> Transition:
  """Transitions with noise for everything; if asked with images, with a window of N
  instants, and with observations of L instants each."""
  rng = np.random.default_rng(seed)

  def normal(*shape: int) -> jax.Array:
    return jnp.asarray(rng.normal(size=shape), jnp.float32)

  def flags(*shape: int) -> jax.Array:
    return jnp.asarray(rng.random(shape) < 0.3)

  def image(*shape: int) -> jax.Array | None:
    return jnp.asarray(rng.integers(0, 256, shape), jnp.uint8) if pixels else None

  def observation(*shape: int) -> Observation:
    shape += (instants,) * bool(instants)
    return Observation(
      robot=normal(*shape, 21),
      tool=0.3 * normal(*shape, 3),
      global_image=image(*shape, 72, 96, 3),
      wrist_image=image(*shape, 36, 64, 3),
      objects=0.3 * normal(*shape, 9),
    )

  def action(*shape: int) -> jax.Array:
    gripper = jnp.asarray(rng.integers(0, 2, (*shape, 1)), jnp.float32)
    return jnp.concatenate([jnp.tanh(normal(*shape, 6)), gripper], axis=-1)

  def slots(*shape: int) -> Slot:
    timestep = TimeStep(
      observation=observation(*shape),
      reward=normal(*shape),
      terminated=flags(*shape),
      truncated=flags(*shape),
      primitives=action(*shape, 3),
    )
    return Slot(timestep, action(*shape), log_prob=normal(*shape))

  success = flags(batch).astype(jnp.float32)
  return Transition(
    observation_tm1=observation(batch),
    action_tm1=action(batch),
    reward_t=success,
    discount_t=0.97 * (1.0 - success),
    observation_t=observation(batch),
    primitives_tm1=action(batch, 3),
    weight=jnp.ones(batch),
    window=slots(batch, windows) if windows else None,
  )
