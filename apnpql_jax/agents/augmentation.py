"""Augmentation of the images of a batch: random shifts and color jitter.

A network that sees each image a little elsewhere and in other colors cannot tell
states by single pixels.
"""

from __future__ import annotations

from collections.abc import Callable
import functools

import jax
import jax.numpy as jnp

from apnpql_jax.types import Array, Observation, Transition

_IMAGES = ("global_image", "wrist_image")


def augment(
  key: Array, batch: Transition, *, shift: int, jitter: float, together: bool = False
) -> Transition:
  """The batch with other images; each image of each instant by itself.

  Args:
    key: typed PRNG key.
    batch: [B, ...].
    shift: largest shift along each axis, pixels; 0 for none.
    jitter: largest change of brightness of each color channel, a share; 0 for none.
    together: observations are windows [B, L, ...]; all images of a window are changed
      in the same way, for what differs between them is what an LSTM is to see.
  """
  change = functools.partial(_image, shift=shift, jitter=jitter)
  if together:
    change = jax.vmap(change, in_axes=(None, -4), out_axes=-4)
  changed = functools.partial(_observation, change)
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


def _observation(
  change: Callable[[Array, Array], Array], key: Array, observation: Observation
) -> Observation:
  for index, name in enumerate(_IMAGES):
    image = getattr(observation, name)
    if image is not None:
      image = change(jax.random.fold_in(key, index), image)
      observation = observation.replace(**{name: image})
  return observation


def _image(key: Array, image: Array, *, shift: int, jitter: float) -> Array:
  shift_key, color_key = jax.random.split(key)
  if shift:
    image = shift_images(shift_key, image, shift)
  if jitter:
    image = jitter_colors(color_key, image, jitter)
  return image


def shift_images(key: Array, image: Array, most: int) -> Array:
  """Moves images by whole pixels; the border is repeated where nothing is known.

  Args:
    key: typed PRNG key.
    image: u8[*b, H, W, 3].
    most: largest shift along each axis, pixels.
  """
  flat = image.reshape(-1, *image.shape[-3:])
  padded = jnp.pad(flat, ((0, 0), (most, most), (most, most), (0, 0)), "edge")
  starts = jax.random.randint(key, (len(flat), 2), 0, 2 * most + 1)

  def crop(image: Array, start: Array) -> Array:
    return jax.lax.dynamic_slice(image, (start[0], start[1], 0), flat.shape[1:])

  return jax.vmap(crop)(padded, starts).reshape(image.shape)


def jitter_colors(key: Array, image: Array, most: float) -> Array:
  """Multiplies each color channel of each image by a factor of its own.

  Args:
    key: typed PRNG key.
    image: u8[*b, H, W, 3].
    most: factors lie within 1 - most and 1 + most.
  """
  shape = (*image.shape[:-3], 1, 1, 3)
  factor = 1.0 + jax.random.uniform(key, shape, jnp.float32, -most, most)
  return jnp.minimum(jnp.round(image * factor), 255.0).astype(jnp.uint8)
