"""Procedural textures, computed from where a ray hits a geom.

Three waves run through each geom, fixed to it. Where their half waves make an odd sum
the geom has its other color, which gives a checker if they run along its axes; and
their height takes some of its brightness, which gives noise if they do not. The
background is a sphere of one meter around the camera, fixed to the world.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from apnpql_jax.render.intersect import MISS, Frames, Rays

Array = jax.Array


class Texture(NamedTuple):
  """Waves through n things, of which the last is the background."""

  waves: Array  # f32[n, 3, 4]: vectors in the geom's own frame, 1/m; phases, turns
  grain: Array  # f32[n]: share of the brightness that noise takes at most


def odd_square(x: Array, y: Array) -> Array:
  """f32[P]: one on the odd squares of a checker of edge one, zero on the even ones."""
  return _odd(jnp.floor(x) + jnp.floor(y))


def _odd(x: Array) -> Array:
  return x - 2.0 * jnp.floor(x * 0.5)


def textured(
  frames: Frames,
  texture: Texture,
  cam_xmat: Array,
  rays: Rays,
  t: Array,
  paint: Array,
) -> Array:
  """f32[P]: paint with the texture of what has been hit.

  Done once per pixel for what is seen there, not at each intersection: there it took
  sixteen times as long, because XLA did not keep the fold over the geoms in one piece.

  Args:
    frames: of the geoms, [n - 1, ...].
    texture: of the n things.
    cam_xmat: f32[3, 3], world rotation of the camera.
    rays: rays of the image.
    t: f32[P], depth of what has been hit on each ray, or ``MISS``.
    paint: f32[P], see ``raycast``.
  """
  waves, grain = texture
  axes = jnp.stack([frames.x, frames.y, frames.z], axis=1)
  axes = jnp.concatenate([axes, cam_xmat[None]])  # Its rows are the world's axes.
  offset = jnp.pad(frames.offset, ((0, 1), (0, 0)))
  t = jnp.where(t < MISS, t, jnp.sqrt(rays.inv_norm2))
  # In the camera's frame: the phase at a depth is then one inner product with the ray.
  ahead = (waves[:, :, :3, None] * axes[:, None]).sum(axis=2)
  start = waves[:, :, 3] - (waves[:, :, :3] * offset[:, None]).sum(axis=2)
  index = jnp.floor(paint)
  entry = index.astype(jnp.int32)

  def of_hit(values: Array) -> Array:
    return jnp.take(values, entry, mode="clip")

  halves, height = jnp.zeros(t.shape, jnp.float32), jnp.zeros(t.shape, jnp.float32)
  for i in range(waves.shape[1]):
    vector = [of_hit(ahead[:, i, j]) for j in range(3)]
    turns = t * (vector[0] * rays.u + vector[1] * rays.v - vector[2])
    turns = turns + of_hit(start[:, i])
    halves = halves + jnp.floor(2.0 * turns)
    # A sine in shape, but without its costly reduction of large angles.
    slope = jnp.abs(2.0 * (turns - jnp.floor(turns)) - 1.0)
    height = height + slope * slope * (3.0 - 2.0 * slope)
  dim = 1.0 - of_hit(grain) * height / waves.shape[1]
  return index + len(waves) * _odd(halves) + dim * (paint - index)
