"""Geometry that the tasks share: headings, turns, funnels.

Batched over worlds on the first axis; lengths in m, angles in rad.
"""

from __future__ import annotations

import jax.numpy as jnp

from apnpql_jax.types import Array

REST_SPEED = 0.05
"""m/s; above float32 contact noise, and slow enough to stop within a millimeter:
v^2 / 2 mu g is 0.7 mm at mu = 0.2."""

REST_TURN = 0.5
"""rad/s."""

POINTER = 0.2
"""m; a direction is observed as a point this far away, so that a turn by a few
degrees weighs as much as a few centimeters."""


def norm(x: Array) -> Array:
  """f32[*b, n] -> f32[*b], with a gradient at zero."""
  return jnp.sqrt((x**2).sum(-1) + 1e-12)


def yaw(quat: Array) -> Array:
  """Heading of the x axis over the table, f32[*b, 4] (wxyz) -> f32[*b]."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def axis(quat: Array, index: int) -> Array:
  """One axis of a rotated frame, f32[*b, 4] (wxyz) -> f32[*b, 3]."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  columns = (
    (1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)),
    (2 * (x * y - w * z), 1 - 2 * (x**2 + z**2), 2 * (y * z + w * x)),
    (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)),
  )
  return jnp.stack(columns[index], -1)


def level_heading(quat: Array) -> Array:
  """Heading of the most level axis of a box, which may lie on any of its faces.

  f32[*b, 4] (wxyz) -> f32[*b].
  """
  axes = jnp.stack([axis(quat, i) for i in range(3)])
  level = jnp.argmin(jnp.abs(axes[..., 2]), axis=0)
  x, y = (jnp.take_along_axis(axes[..., i], level[None], axis=0)[0] for i in range(2))
  return jnp.arctan2(y, x)


def fold(angle: Array, period: float) -> Array:
  """The equivalent angle nearest to zero of a shape that repeats every ``period``.

  f32[*b] -> f32[*b].
  """
  return angle - period * jnp.round(angle / period)


def turn_z(angle: Array) -> Array:
  """Rotation about the world's z axis, f32[*b] -> f32[*b, 3, 3]."""
  c, s, zero, one = jnp.cos(angle), jnp.sin(angle), 0 * angle, 0 * angle + 1
  rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
  return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def up(xy: Array, height: Array | float) -> Array:
  """The point at ``height`` over ``xy``, f32[*b, 2] -> f32[*b, 3]."""
  height = jnp.broadcast_to(jnp.asarray(height), xy.shape[:-1])
  return jnp.concatenate([xy, height[..., None]], -1)


def is_at_rest(twist: Array) -> Array:
  """Linear and angular velocity f32[*b, 6] near zero -> bool[*b]."""
  return (norm(twist[..., :3]) < REST_SPEED) & (norm(twist[..., 3:]) < REST_TURN)


def funnel(off: Array, *, aligned: float, wide: float) -> Array:
  """0 within ``aligned``, 1 beyond ``wide``, linear between: how far to stay up.

  f32[*b] (m) -> f32[*b]. A step instead would be sharper than a network can see in
  the images.
  """
  return ((off - aligned) / (wide - aligned)).clip(0.0, 1.0)
