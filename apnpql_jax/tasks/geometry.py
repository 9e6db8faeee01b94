"""Geometry shared by the tasks, in m and rad; quaternions are wxyz."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Bool, Float

from apnpql_jax.types import Array

REST_SPEED = 0.05  # m/s; above contact noise, and stops within 0.7 mm at mu = 0.2
REST_TURN = 0.5  # rad/s
POINTER = 0.2  # m to the point that a direction is observed as: 0.1 rad counts as 2 cm


def norm(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
  """Returns the length of a vector, with a gradient at zero."""
  return jnp.sqrt((x**2).sum(-1) + 1e-12)


def yaw(quat: Float[Array, "*b 4"]) -> Float[Array, "*b"]:
  """Returns the heading of the x axis over the table."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def axis(quat: Float[Array, "*b 4"], index: int) -> Float[Array, "*b 3"]:
  """Returns one axis of a rotated frame."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  columns = (
    (1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)),
    (2 * (x * y - w * z), 1 - 2 * (x**2 + z**2), 2 * (y * z + w * x)),
    (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)),
  )
  return jnp.stack(columns[index], -1)


def level_heading(quat: Float[Array, "*b 4"]) -> Float[Array, "*b"]:
  """Returns the heading of the most level axis of a box, which may lie on any face."""
  axes = jnp.stack([axis(quat, i) for i in range(3)])
  level = jnp.argmin(jnp.abs(axes[..., 2]), axis=0)
  x, y = (jnp.take_along_axis(axes[..., i], level[None], axis=0)[0] for i in range(2))
  return jnp.arctan2(y, x)


def fold(angle: Float[Array, "*b"], period: float) -> Float[Array, "*b"]:
  """Returns the angle nearest to zero for a shape that repeats every ``period``."""
  return angle - period * jnp.round(angle / period)


def rotation_z(angle: Float[Array, "*b"]) -> Float[Array, "*b 3 3"]:
  """Returns the rotation about the world's z axis."""
  c, s, zero, one = jnp.cos(angle), jnp.sin(angle), 0 * angle, 0 * angle + 1
  rows = [[c, -s, zero], [s, c, zero], [zero, zero, one]]
  return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def at_height(
  xy: Float[Array, "*b 2"], height: Float[Array, "*b"] | float
) -> Float[Array, "*b 3"]:
  """Returns the point at ``height`` over ``xy``."""
  height = jnp.broadcast_to(jnp.asarray(height), xy.shape[:-1])
  return jnp.concatenate([xy, height[..., None]], -1)


def is_at_rest(twist: Float[Array, "*b 6"]) -> Bool[Array, "*b"]:
  """Checks that linear (m/s) and angular velocity (rad/s) are near zero."""
  return (norm(twist[..., :3]) < REST_SPEED) & (norm(twist[..., 3:]) < REST_TURN)


def funnel(
  off: Float[Array, "*b"], *, aligned: float, wide: float
) -> Float[Array, "*b"]:
  """Returns 0 within ``aligned`` (stay down), 1 beyond ``wide``, linear between."""
  # A step would be sharper than a network can see in the images.
  return ((off - aligned) / (wide - aligned)).clip(0.0, 1.0)
