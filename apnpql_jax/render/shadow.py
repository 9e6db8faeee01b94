"""Hard shadows of chosen geoms on chosen others, under a directional light.

The light's rays are parallel, so a point is in the shadow of a capsule where the two
are close after projection along the light: no root is needed. That the caster is
between light and point is taken for granted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.render.geoms import Geoms
from apnpql_jax.render.intersect import Frames, Rays, along, row

Array = jax.Array

_TINY = 1e-12


def light_basis(direction: Any, xp: Any = np) -> Any:
  """f32[3, 3]: rows e1, e2 across the light and l towards it, in world axes.

  Args:
    direction: [3], in which the light travels.
    xp: ``numpy`` or ``jax.numpy``.
  """
  toward = -xp.asarray(direction)
  toward = toward / xp.linalg.norm(toward)
  helper = xp.eye(3)[xp.argmin(xp.abs(toward))]
  e1 = xp.cross(helper, toward)
  e1 = e1 / xp.linalg.norm(e1)
  return xp.stack([e1, xp.cross(toward, e1), toward]).astype(np.float32)


def capsule_shadow(g: Frames, rays: Rays, t: Array, basis: Array) -> Array:
  """bool[P]: whether a capsule (or a sphere, with half length 0) darkens a point.

  Args:
    g: the caster.
    rays: rays of the image.
    t: f32[P], depth of the point on each ray.
    basis: f32[3, 3], ``light_basis`` in the camera's frame.

  Returns:
    True where the line along the light meets the caster.
  """
  axis = [(g.z * basis[k]).sum() for k in range(2)]
  center = [(g.center * basis[k]).sum() for k in range(2)]
  inv = 1.0 / (axis[0] * axis[0] + axis[1] * axis[1] + _TINY)
  x, y = (t * along(basis[k], rays) - center[k] for k in range(2))
  s = jnp.clip((x * axis[0] + y * axis[1]) * inv, -g.size[1], g.size[1])
  x, y = x - s * axis[0], y - s * axis[1]
  return x * x + y * y < g.size[0] * g.size[0]


def box_shadow(g: Frames, rays: Rays, t: Array, basis: Array) -> Array:
  """bool[P]: whether a box darkens a point; arguments as of ``capsule_shadow``."""
  del basis
  enter, leave = [], []
  for k, axis in enumerate((g.x, g.y, g.z)):
    inv = 1.0 / (g.light[k] + _TINY)
    middle = (g.offset[k] - t * along(axis, rays)) * inv
    width = g.size[k] * jnp.abs(inv)
    enter.append(middle - width)
    leave.append(middle + width)
  first = jnp.maximum(jnp.maximum(enter[0], enter[1]), enter[2])
  last = jnp.minimum(jnp.minimum(leave[0], leave[1]), leave[2])
  return first <= last


SHADOWS: dict[int, Callable[[Frames, Rays, Array, Array], Array]] = {
  int(mujoco.mjtGeom.mjGEOM_SPHERE): capsule_shadow,
  int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule_shadow,
  int(mujoco.mjtGeom.mjGEOM_BOX): box_shadow,
}
"""Shadow test by ``mujoco.mjtGeom``."""


def darkness(
  geoms: Geoms,
  casters: tuple[int, ...],
  frames: Frames,
  rays: Rays,
  t: Array,
  basis: Array,
) -> Array:
  """bool[P]: whether any of the casters, given by MuJoCo id, darkens a point.

  Raises:
    ValueError: a caster is not drawn or is not a sphere, capsule or box.
  """
  dark = jnp.zeros(t.shape, bool)
  for k in geoms.rows(casters, SHADOWS):
    dark = dark | SHADOWS[int(geoms.types[k])](row(frames, k), rays, t, basis)
  return dark
