"""Hard shadows of chosen geoms on chosen others, under a directional light.

The light's rays are parallel, so a point is in the shadow of a capsule if the two are
close after projection along the light: no root is needed. The tests assume that the
caster is between light and point.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.render.intersect import TINY, Frames, Rays, along, slab
from apnpql_jax.types import Array


def light_basis(direction: Any, xp: Any = np) -> Any:
  """Returns f32[3, 3]: rows e1, e2 across the light and l toward it, in world axes."""
  toward = -xp.asarray(direction)
  toward = toward / xp.linalg.norm(toward)
  helper = xp.eye(3)[xp.argmin(xp.abs(toward))]
  e1 = xp.cross(helper, toward)
  e1 = e1 / xp.linalg.norm(e1)
  return xp.stack([e1, xp.cross(toward, e1), toward]).astype(np.float32)


def capsule_shadow(g: Frames, rays: Rays, t: Array, basis: Array) -> Array:
  """Returns whether a capsule, or a sphere with half length 0, darkens each point.

  The points are at depth t on the rays; ``basis`` is in the camera's frame.
  """
  # Distance of the projected point from the projected axis.
  axis = [(g.z * basis[k]).sum() for k in range(2)]
  center = [(g.center * basis[k]).sum() for k in range(2)]
  inv = 1.0 / (axis[0] * axis[0] + axis[1] * axis[1] + TINY)
  x, y = (t * along(basis[k], rays) - center[k] for k in range(2))
  s = jnp.clip((x * axis[0] + y * axis[1]) * inv, -g.size[1], g.size[1])
  x, y = x - s * axis[0], y - s * axis[1]
  return x * x + y * y < g.size[0] * g.size[0]


def box_shadow(g: Frames, rays: Rays, t: Array, basis: Array) -> Array:
  """Returns whether a box darkens each point; see ``capsule_shadow``."""
  del basis
  slabs = [
    slab(g.light[k], g.offset[k] - t * along(axis, rays), g.size[k])
    for k, axis in enumerate((g.x, g.y, g.z))
  ]
  enter, leave = zip(*slabs, strict=True)
  return functools.reduce(jnp.maximum, enter) <= functools.reduce(jnp.minimum, leave)


# Shadow test by ``mujoco.mjtGeom``.
SHADOWS: dict[int, Callable[[Frames, Rays, Array, Array], Array]] = {
  int(mujoco.mjtGeom.mjGEOM_SPHERE): capsule_shadow,
  int(mujoco.mjtGeom.mjGEOM_CAPSULE): capsule_shadow,
  int(mujoco.mjtGeom.mjGEOM_BOX): box_shadow,
}
