"""Where a camera ray first enters a primitive, in closed form.

All rays of an image start at the camera, so they are ``t * (u, v, -1)`` in the
camera's frame, and ``t`` is the depth. What depends on the geom alone is computed
once per image (``prepare``); the ``*_hit`` functions do the arithmetic per pixel for
one geom. They return the depth and the cosine between outward normal and light. A
ray that misses has depth ``MISS``; where the geom lies behind the camera or around it
the depth is negative, and the caller drops it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

Array = jax.Array

MISS = 1e30
"""Depth of a ray that hits nothing; finite, so that no arithmetic makes NaN of it."""

_TINY = 1e-12
_NUDGE = 1e-7  # rad; turns a ray off a cylinder's axis, where its equation is 0 / 0


class Rays(NamedTuple):
  """Directions (u, v, -1) of the P pixels of an image, in the camera's frame."""

  u: np.ndarray | Array  # f32[P]
  v: np.ndarray | Array  # f32[P]
  norm2: np.ndarray | Array  # f32[P]: squared length of the direction
  inv_norm2: np.ndarray | Array  # f32[P]


class Frames(NamedTuple):
  """What the intersections need to know of n geoms; of one geom without the n."""

  x: Array  # f32[n, 3]: axes of the geom in the camera's frame
  y: Array  # f32[n, 3]
  z: Array  # f32[n, 3]
  center: Array  # f32[n, 3]: in the camera's frame, m
  offset: Array  # f32[n, 3]: the same in the geom's own frame, m
  light: Array  # f32[n, 3]: unit vector towards the light in the geom's own frame
  center_light: Array  # f32[n]: inner product of center and light, m
  center_norm2: Array  # f32[n]: squared distance of the center, m^2
  size: Array  # f32[n, 3]: MuJoCo half sizes, m
  inv_radius: Array  # f32[n]: 1 / size[0], of use where that is a radius


def make_rays(height: int, width: int, fovy_deg: float) -> Rays:
  """Rays through the pixel centers, row by row from the upper left."""
  pixel = 2.0 * np.tan(np.radians(fovy_deg) / 2.0) / height
  x = (np.arange(width) + 0.5 - width / 2.0) * pixel
  y = (height / 2.0 - np.arange(height) - 0.5) * pixel
  u, v = (a.reshape(-1) for a in np.meshgrid(x, y))
  norm2 = u * u + v * v + 1.0
  return Rays(*(a.astype(np.float32) for a in (u, v, norm2, 1.0 / norm2)))


def zoomed(rays: Rays, zoom: Array) -> Rays:
  """The same pixels of a camera whose image is ``zoom`` times as wide at unit depth."""
  u, v = rays.u * zoom, rays.v * zoom
  norm2 = u * u + v * v + 1.0
  return Rays(u, v, norm2, 1.0 / norm2)


def along(w: Array, rays: Rays) -> Array:
  """f32[P]: inner product of a vector f32[3] with every ray direction."""
  return w[0] * rays.u + w[1] * rays.v - w[2]


def prepare(
  center: Array, axes: Array, size: Array | np.ndarray, to_light: Array
) -> Frames:
  """Per-geom part of the intersections.

  Args:
    center: f32[n, 3], geom positions in the camera's frame.
    axes: f32[n, 3, 3], their rotations; the columns are the geoms' axes.
    size: f32[n, 3], MuJoCo half sizes.
    to_light: f32[3], unit vector towards the light in the camera's frame.

  Returns:
    The frames, every field with a leading n.
  """
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
    inv_radius=1.0 / jnp.maximum(size[:, 0], _TINY),
  )


def row(frames: Frames, k: int) -> Frames:
  """The frame of geom k alone."""
  return Frames(*(field[k] for field in frames))


def plane_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """A plane, seen from its front only; rectangular where its sizes are positive."""
  del ray_light
  toward = along(g.z, rays)
  t = g.offset[2] / toward
  x, y = plane_point(g, rays, t)
  inside = (jnp.abs(x) <= _extent(g.size[0])) & (jnp.abs(y) <= _extent(g.size[1]))
  hit = (toward < 0.0) & inside
  return jnp.where(hit, t, MISS), g.light[2]


def _extent(size: Array) -> Array:
  return jnp.where(size > 0.0, size, MISS)


def plane_point(g: Frames, rays: Rays, t: Array) -> tuple[Array, Array]:
  """f32[P] twice: coordinates on the plane of the points at depth t."""
  return t * along(g.x, rays) - g.offset[0], t * along(g.y, rays) - g.offset[1]


def sphere_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """A sphere of radius size[0]."""
  radius = g.size[0]
  t, found = _ball(along(g.center, rays), g.center_norm2 - radius * radius, rays)
  return jnp.where(found, t, MISS), (t * ray_light - g.center_light) * g.inv_radius


def _ball(b: Array, c: Array, rays: Rays) -> tuple[Array, Array]:
  """Smaller root of norm2 t^2 - 2 b t + c = 0, and whether there is one."""
  discriminant = b * b - rays.norm2 * c
  root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
  return (b - root) * rays.inv_norm2, discriminant > 0.0


def ellipsoid_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """An ellipsoid of half axes size, which is a ball where these measure lengths."""
  del ray_light
  inv = 1.0 / jnp.maximum(g.size, _TINY)
  x, y, z = (along(axis, rays) * inv[k] for k, axis in enumerate((g.x, g.y, g.z)))
  p, q, r = (g.offset[k] * inv[k] for k in range(3))
  a, b = x * x + y * y + z * z, x * p + y * q + z * r
  # As of a tube, by a cross product.
  cross = (y * r - z * q, z * p - x * r, x * q - y * p)
  discriminant = a - (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2])
  t = (b - jnp.sqrt(jnp.maximum(discriminant, 0.0))) / a
  normal = ((t * x - p) * inv[0], (t * y - q) * inv[1], (t * z - r) * inv[2])
  length2 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]
  cosine = normal[0] * g.light[0] + normal[1] * g.light[1] + normal[2] * g.light[2]
  return jnp.where(discriminant > 0.0, t, MISS), cosine * jax.lax.rsqrt(length2)


def _tube(g: Frames, rays: Rays) -> tuple[Array, Array, Array, Array, Array, Array]:
  """Entry and exit of the infinite cylinder of radius size[0] along the geom's z.

  Returns:
    Entry, exit, whether it is hit at all, then what a capsule shares: inner product
    of transverse direction and offset, axial direction, and axial entry point
    measured from the center.
  """
  dx, dy, dz = along(g.x, rays) + _NUDGE, along(g.y, rays), along(g.z, rays)
  inv_a = 1.0 / (dx * dx + dy * dy)
  b = dx * g.offset[0] + dy * g.offset[1]
  # Distance of ray and axis by their cross product: b^2 - a c would cancel.
  cross = dx * g.offset[1] - dy * g.offset[0]
  discriminant = (dx * dx + dy * dy) * (g.size[0] * g.size[0]) - cross * cross
  root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
  enter = (b - root) * inv_a
  return enter, (b + root) * inv_a, discriminant > 0.0, b, dz, enter * dz - g.offset[2]


def capsule_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """A capsule of radius size[0] and half length size[1] along z."""
  radius, half = g.size[0], g.size[1]
  t_tube, _, in_tube, b, dz, axial = _tube(g, rays)
  # Point of the axis whose ball is hit: where the tube is entered, else an end.
  end = jnp.clip(axial, -half, half)
  c = g.center_norm2 - radius * radius + end * (2.0 * g.offset[2] + end)
  t_ball, in_ball = _ball(b + dz * (g.offset[2] + end), c, rays)
  on_tube = axial == end
  t = jnp.where(on_tube, t_tube, t_ball)
  hit = in_tube & (on_tube | in_ball)
  cosine = (t * ray_light - g.center_light - end * g.light[2]) * g.inv_radius
  return jnp.where(hit, t, MISS), cosine


def cylinder_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """A cylinder of radius size[0] and half length size[1] along z."""
  t_side, exit_side, in_tube, _, dz, _ = _tube(g, rays)
  t_cap, exit_cap = _slab(dz, g.offset[2], g.size[1])
  t = jnp.maximum(t_side, t_cap)
  hit = in_tube & (t <= jnp.minimum(exit_side, exit_cap))
  axial = t * dz - g.offset[2]
  side = (t * ray_light - g.center_light - axial * g.light[2]) * g.inv_radius
  cosine = jnp.where(t_cap > t_side, _facing(dz, g.light[2]), side)
  return jnp.where(hit, t, MISS), cosine


def _slab(d: Array, offset: Array, half: Array) -> tuple[Array, Array]:
  """Depths at which a ray enters and leaves |coordinate| <= half."""
  inv = 1.0 / (d + _TINY)
  middle, width = offset * inv, half * jnp.abs(inv)
  return middle - width, middle + width


def _facing(d: Array, light: Array) -> Array:
  """Cosine with the light of whichever of two opposite faces the ray comes upon."""
  return jnp.where(d > 0.0, -light, light)


def box_hit(g: Frames, rays: Rays, ray_light: Array) -> tuple[Array, Array]:
  """A box of half sizes size."""
  del ray_light
  dirs = [along(axis, rays) for axis in (g.x, g.y, g.z)]
  slabs = [_slab(d, g.offset[k], g.size[k]) for k, d in enumerate(dirs)]
  enter = [slab[0] for slab in slabs]
  t = jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2])
  leave = jnp.minimum(jnp.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])
  hit = t <= leave
  face = [_facing(d, g.light[k]) for k, d in enumerate(dirs)]
  cosine = jnp.where(t == enter[0], face[0], jnp.where(t == enter[1], face[1], face[2]))
  return jnp.where(hit, t, MISS), cosine


Hit = Callable[[Frames, Rays, Array], tuple[Array, Array]]

HITS: dict[int, Hit] = {
  int(mujoco.mjtGeom.mjGEOM_PLANE): plane_hit,
  int(mujoco.mjtGeom.mjGEOM_SPHERE): sphere_hit,
  int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule_hit,
  int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ellipsoid_hit,
  int(mujoco.mjtGeom.mjGEOM_BOX): box_hit,
  int(mujoco.mjtGeom.mjGEOM_CYLINDER): cylinder_hit,
}
"""Intersection by ``mujoco.mjtGeom``."""
