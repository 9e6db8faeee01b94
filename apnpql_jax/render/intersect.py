"""Closed-form intersections of camera rays with primitives.

All rays of an image start at the camera: they are ``t * (u, v, -1)`` in its frame, and
``t`` is the depth. ``prepare`` computes once per image what depends on the geom alone;
the ``*_hit`` functions do the arithmetic per pixel for one geom. They return the depth
and the cosine between outward normal and light. A ray that misses has depth ``MISS``.
If the geom is behind or around the camera, the depth is negative; the caller drops it.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float
import mujoco
import numpy as np

from apnpql_jax.types import Array

MISS = 1e30  # depth without a hit; finite, so that no arithmetic turns it into NaN
TINY = 1e-12  # avoids division by zero
_NUDGE = 1e-7  # turns rays off a cylinder's axis, where its equation is 0 / 0


class Rays(NamedTuple):
  """Directions (u, v, -1) of the P pixels of an image, in the camera's frame."""

  u: np.ndarray | Array  # f32[P]
  v: np.ndarray | Array
  norm2: np.ndarray | Array  # squared length of the direction
  inv_norm2: np.ndarray | Array


class Frames(NamedTuple):
  """Inputs of the intersections with n geoms; without the leading n for one geom."""

  x: Float[Array, "n 3"]  # axes of the geom in the camera's frame
  y: Float[Array, "n 3"]
  z: Float[Array, "n 3"]
  center: Float[Array, "n 3"]  # in the camera's frame, m
  offset: Float[Array, "n 3"]  # the same in the geom's own frame, m
  light: Float[Array, "n 3"]  # unit vector toward the light in the geom's own frame
  center_light: Float[Array, " n"]  # inner product of center and light, m
  center_norm2: Float[Array, " n"]  # squared distance of the center, m^2
  size: Float[Array, "n 3"]  # MuJoCo half sizes, m
  inv_radius: Float[Array, " n"]  # 1 / size[0], for geoms where that is a radius


def make_rays(height: int, width: int, fovy_deg: float) -> Rays:
  """Returns the rays through the pixel centers, row by row from the upper left."""
  pixel = 2.0 * np.tan(np.radians(fovy_deg) / 2.0) / height
  x = (np.arange(width) + 0.5 - width / 2.0) * pixel
  y = (height / 2.0 - np.arange(height) - 0.5) * pixel
  u, v = (a.reshape(-1) for a in np.meshgrid(x, y))
  norm2 = u * u + v * v + 1.0
  return Rays(*(a.astype(np.float32) for a in (u, v, norm2, 1.0 / norm2)))


def zoom_rays(rays: Rays, zoom: Array) -> Rays:
  """Returns the rays of a camera whose view is ``zoom`` times as wide at unit depth."""
  u, v = rays.u * zoom, rays.v * zoom
  norm2 = u * u + v * v + 1.0
  return Rays(u, v, norm2, 1.0 / norm2)


def along(w: Array, rays: Rays) -> Array:
  """Returns the inner products f32[P] of a vector f32[3] with all ray directions."""
  return w[0] * rays.u + w[1] * rays.v - w[2]


def prepare(
  center: Array, axes: Array, size: Array | np.ndarray, to_light: Array
) -> Frames:
  """Computes the part per geom; vectors, and axes as columns, in the camera's frame."""
  # Sums, not einsum: XLA's CPU backend would call a library for each tiny product.
  return Frames(
    x=axes[:, :, 0],
    y=axes[:, :, 1],
    z=axes[:, :, 2],
    center=center,
    offset=(axes * center[:, :, None]).sum(axis=1),
    light=(axes * to_light[None, :, None]).sum(axis=1),
    center_light=(center * to_light[None]).sum(axis=1),
    center_norm2=(center * center).sum(axis=1),
    size=jnp.asarray(size),
    inv_radius=1.0 / jnp.maximum(size[:, 0], TINY),
  )


def row(frames: Frames, k: int) -> Frames:
  """Returns the inputs of geom k alone."""
  return Frames(*(field[k] for field in frames))


def plane_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects the front of a plane, which is bounded where its sizes are positive."""
  del ray_light
  toward = along(g.z, rays)
  t = g.offset[2] / toward
  x, y = plane_point(g, rays, t)
  width, height = (jnp.where(g.size[k] > 0.0, g.size[k], MISS) for k in range(2))
  inside = (jnp.abs(x) <= width) & (jnp.abs(y) <= height)
  hit = (toward < 0.0) & inside
  return jnp.where(hit, t, MISS), g.light[2]


def plane_point(g: Frames, rays: Rays, t: Array) -> tuple[Array, Array]:
  """Returns x and y on the plane, f32[P] each, of the points at depth t."""
  return t * along(g.x, rays) - g.offset[0], t * along(g.y, rays) - g.offset[1]


def sphere_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects a sphere of radius size[0]."""
  radius = g.size[0]
  t, found = _ball(along(g.center, rays), g.center_norm2 - radius * radius, rays)
  return jnp.where(found, t, MISS), (t * ray_light - g.center_light) * g.inv_radius


def _ball(b: Array, c: Array, rays: Rays) -> tuple[Array, Array]:
  """Returns the smaller root of norm2 t^2 - 2 b t + c = 0, and whether it exists."""
  discriminant = b * b - rays.norm2 * c
  root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
  return (b - root) * rays.inv_norm2, discriminant > 0.0


def ellipsoid_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects an ellipsoid of half axes size: a unit ball after scaling by them."""
  del ray_light
  inv = 1.0 / jnp.maximum(g.size, TINY)
  x, y, z = (along(axis, rays) * inv[k] for k, axis in enumerate((g.x, g.y, g.z)))
  p, q, r = (g.offset[k] * inv[k] for k in range(3))
  a, b = x * x + y * y + z * z, x * p + y * q + z * r
  # Distance of ray and center by a cross product, as in ``_tube``.
  cross = (y * r - z * q, z * p - x * r, x * q - y * p)
  discriminant = a - (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2])
  t = (b - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / a
  normal = ((t * x - p) * inv[0], (t * y - q) * inv[1], (t * z - r) * inv[2])
  length2 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
  cosine = normal[0] * g.light[0] + normal[1] * g.light[1] + normal[2] * g.light[2]
  return jnp.where(discriminant > 0.0, t, MISS), cosine * jax.lax.rsqrt(length2)


def _tube(g: Frames, rays: Rays) -> tuple[Array, Array, Array, Array, Array, Array]:
  """Intersects the infinite cylinder of radius size[0] along the geom's z.

  Returns entry, exit, whether it is hit, inner product of transverse direction and
  offset, axial direction, and axial entry point measured from the center.
  """
  dx, dy, dz = along(g.x, rays) + _NUDGE, along(g.y, rays), along(g.z, rays)
  inv_a = 1.0 / (dx * dx + dy * dy)
  b = dx * g.offset[0] + dy * g.offset[1]
  # Distance of ray and axis by a cross product: b^2 - a c would lose precision.
  cross = dx * g.offset[1] - dy * g.offset[0]
  discriminant = (dx * dx + dy * dy) * (g.size[0] * g.size[0]) - cross * cross
  root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
  enter = (b - root) * inv_a
  return enter, (b + root) * inv_a, discriminant > 0.0, b, dz, enter * dz - g.offset[2]


def capsule_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects a capsule of radius size[0] and half length size[1] along z."""
  radius, half = g.size[0], g.size[1]
  t_tube, _, in_tube, b, dz, axial = _tube(g, rays)
  # Center of the ball that is hit: the axial entry point, clipped to the ends.
  end = jnp.clip(axial, -half, half)
  c = g.center_norm2 - radius * radius + end * (2.0 * g.offset[2] + end)
  t_ball, in_ball = _ball(b + dz * (g.offset[2] + end), c, rays)
  on_tube = axial == end
  t = jnp.where(on_tube, t_tube, t_ball)
  hit = in_tube & (on_tube | in_ball)
  cosine = (t * ray_light - g.center_light - end * g.light[2]) * g.inv_radius
  return jnp.where(hit, t, MISS), cosine


def cylinder_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects a cylinder of radius size[0] and half length size[1] along z."""
  t_side, exit_side, in_tube, _, dz, _ = _tube(g, rays)
  t_cap, exit_cap = slab(dz, g.offset[2], g.size[1])
  t = jnp.maximum(t_side, t_cap)
  hit = in_tube & (t <= jnp.minimum(exit_side, exit_cap))
  axial = t * dz - g.offset[2]
  side = (t * ray_light - g.center_light - axial * g.light[2]) * g.inv_radius
  cosine = jnp.where(t_cap > t_side, _facing(dz, g.light[2]), side)
  return jnp.where(hit, t, MISS), cosine


def slab(d: Array, offset: Array, half: Array) -> tuple[Array, Array]:
  """Returns the depths at which a ray enters and leaves |coordinate| <= half."""
  inv = 1.0 / (d + TINY)
  middle, width = offset * inv, half * jnp.abs(inv)
  return middle - width, middle + width


def _facing(d: Array, light: Array) -> Array:
  """Returns the cosine with the light on whichever of two opposite faces is hit."""
  return jnp.where(d > 0.0, -light, light)


def box_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """Intersects a box of half sizes size."""
  del ray_light
  dirs = [along(axis, rays) for axis in (g.x, g.y, g.z)]
  slabs = [slab(d, g.offset[k], g.size[k]) for k, d in enumerate(dirs)]
  enter, leave = zip(*slabs, strict=True)
  t = functools.reduce(jnp.maximum, enter)
  hit = t <= functools.reduce(jnp.minimum, leave)
  face = [_facing(d, g.light[k]) for k, d in enumerate(dirs)]
  cosine = jnp.where(t == enter[0], face[0], jnp.where(t == enter[1], face[1], face[2]))
  return jnp.where(hit, t, MISS), cosine


def hull_hit(
  planes: np.ndarray, g: Frames, rays: Rays, ray_light: Array
) -> tuple[Array, Array]:
  """Intersects a convex hull, given by ``hull.hull_of``: a slab with more faces."""
  del ray_light
  inv = 1.0 / jnp.maximum(g.size, TINY)
  enter, leave = jnp.float32(-MISS), jnp.float32(MISS)
  cosine = jnp.float32(0.0)
  for plane in planes:
    normal = plane[:3] * inv  # In the geom's frame, scaled with it.
    toward = along(normal[0] * g.x + normal[1] * g.y + normal[2] * g.z, rays)
    distance = plane[3] + (normal * g.offset).sum()
    t = distance / jnp.where(toward == 0.0, TINY, toward)
    lit = (normal * g.light).sum() * jax.lax.rsqrt((normal * normal).sum())
    front = (toward < 0.0) & (t > enter)
    enter, cosine = jnp.where(front, t, enter), jnp.where(front, lit, cosine)
    leave = jnp.where(toward > 0.0, jnp.minimum(t, leave), leave)
  return jnp.where(enter <= leave, enter, MISS), cosine


# Intersection by ``mujoco.mjtGeom``; meshes have ``hull_hit``.
HITS: dict[int, Callable[[Frames, Rays, Array], tuple[Array, Array]]] = {
  int(mujoco.mjtGeom.mjGEOM_PLANE): plane_hit,
  int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere_hit,
  int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule_hit,
  int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ellipsoid_hit,
  int(mujoco.mjtGeom.mjGEOM_BOX): box_hit,
  int(mujoco.mjtGeom.mjGEOM_CYLINDER): cylinder_hit,
}
