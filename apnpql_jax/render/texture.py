"""Procedural textures, computed from the point where a ray hits a geom.

Three waves run through each geom and move with it. A point where their numbers of half
waves have an odd sum has the geom's other color: a checker, if the waves run along its
axes. The height of the waves removes some of the brightness: noise, if they run in
other directions. The background is a sphere of one meter around the camera, fixed in
the world.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from apnpql_jax.render.intersect import MISS, Frames, Rays
from apnpql_jax.types import Array


class Texture(NamedTuple):
  """Waves through n - 1 geoms and, last, through the background."""

  waves: Array  # f32[n, 3, 4]: wave vectors in the geom's frame, 1/m; phases, turns
  grain: Array  # f32[n]: largest share of the brightness that noise removes


def odd_square(x: Array, y: Array) -> Array:
  """Returns f32[P]: one on the odd squares of a checker of edge one, zero on others."""
  return _odd(jnp.floor(x) + jnp.floor(y))


def _odd(x: Array) -> Array:
  return x - 2.0 * jnp.floor(x * 0.5)


def apply_texture(
  frames: Frames, texture: Texture, cam_xmat: Array, rays: Rays, t: Array, paint: Array
) -> Array:
  """Returns the paint f32[P], see ``raycast``, with the texture at the depths t.

  Evaluates textures once per pixel, for the visible point. Evaluating them at each
  intersection takes sixteen times as long, because XLA does not compile the fold over
  the geoms into one loop.
  """
  waves, grain = texture
  axes = jnp.stack([frames.x, frames.y, frames.z], axis=1)
  axes = jnp.concatenate([axes, cam_xmat[None]])  # Its rows are the world's axes.
  offset = jnp.pad(frames.offset, ((0, 1), (0, 0)))
  t = jnp.where(t < MISS, t, jnp.sqrt(rays.inv_norm2))
  # Wave vectors in the camera's frame: a phase is then an inner product with the ray.
  ahead = (waves[:, :, :3, None] * axes[:, None]).sum(axis=2)
  start = waves[:, :, 3] - (waves[:, :, :3] * offset[:, None]).sum(axis=2)
  index = jnp.floor(paint)
  entry = index.astype(jnp.int32)

  def at_hit(values: Array) -> Array:
    return jnp.take(values, entry, mode="clip")

  halves, height = jnp.zeros(t.shape, jnp.float32), jnp.zeros(t.shape, jnp.float32)
  for i in range(waves.shape[1]):
    vector = [at_hit(ahead[:, i, j]) for j in range(3)]
    turns = t * (vector[0] * rays.u + vector[1] * rays.v - vector[2])
    turns = turns + at_hit(start[:, i])
    halves = halves + jnp.floor(2.0 * turns)
    # Shaped like a sine, without the costly range reduction of large angles.
    slope = jnp.abs(2.0 * (turns - jnp.floor(turns)) - 1.0)
    height = height + slope * slope * (3.0 - 2.0 * slope)
  dim = 1.0 - at_hit(grain) * height / waves.shape[1]
  return index + len(waves) * _odd(halves) + dim * (paint - index)
