"""Random shifts and color jitter of images, so that no pixel identifies a state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, UInt8

from apnpql_jax.types import Array, Observation, Transition


@jax.named_scope("augment")
def augment(
  key: PRNGKeyArray,
  batch: Transition,
  *,
  shift: int,
  jitter: float,
  together: bool = False,
) -> Transition:
  """Augments every image by ``shift_images`` and ``jitter_colors``; 0 turns one off.

  Every instant changes independently. With ``together``, all instants of a window
  [B, L, ...] change in the same way: an LSTM needs the differences between them.
  """

  def change(key: PRNGKeyArray, image: Array) -> Array:
    shift_key, color_key = jax.random.split(key)
    if shift:
      image = shift_images(shift_key, image, shift)
    if jitter:
      image = jitter_colors(color_key, image, jitter)
    return image

  if together:
    change = jax.vmap(change, in_axes=(None, -4), out_axes=-4)

  def changed(key: PRNGKeyArray, observation: Observation) -> Observation:
    for index, name in enumerate(("global_image", "wrist_image")):
      image = getattr(observation, name)
      if image is not None:
        image = change(jax.random.fold_in(key, index), image)
        observation = observation.replace(**{name: image})
    return observation

  keys = jax.random.split(key, 3)
  batch = batch.replace(
    observation_tm1=changed(keys[0], batch.observation_tm1),
    observation_t=changed(keys[1], batch.observation_t),
  )
  if batch.window is None:
    return batch
  timestep = batch.window.timestep
  timestep = timestep.replace(observation=changed(keys[2], timestep.observation))
  return batch.replace(window=batch.window.replace(timestep=timestep))


def shift_images(
  key: PRNGKeyArray, image: UInt8[Array, "*b H W 3"], most: int
) -> UInt8[Array, "*b H W 3"]:
  """Moves images by up to ``most`` whole pixels per axis, repeating the border."""
  flat = image.reshape(-1, *image.shape[-3:])
  padded = jnp.pad(flat, ((0, 0), (most, most), (most, most), (0, 0)), "edge")
  starts = jax.random.randint(key, (len(flat), 2), 0, 2 * most + 1)

  def crop(image: Array, start: Array) -> Array:
    return jax.lax.dynamic_slice(image, (start[0], start[1], 0), flat.shape[1:])

  return jax.vmap(crop)(padded, starts).reshape(image.shape)


def jitter_colors(
  key: PRNGKeyArray, image: UInt8[Array, "*b H W 3"], most: float
) -> UInt8[Array, "*b H W 3"]:
  """Multiplies each color channel of each image by a factor in 1 - most to 1 + most."""
  shape = (*image.shape[:-3], 1, 1, 3)
  factor = 1.0 + jax.random.uniform(key, shape, jnp.float32, -most, most)
  return jnp.minimum(jnp.round(image * factor), 255.0).astype(jnp.uint8)
