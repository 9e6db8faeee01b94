"""Appearance of a world, as far as it may differ between worlds.

``Geoms``, ``CameraSpec`` and ``Lighting`` hold the defaults of all worlds; a field
replaces them. Whatever no field replaces stays a constant of the program.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from apnpql_jax.render.geoms import CameraSpec, Geoms, Lighting
from apnpql_jax.render.shadow import light_basis
from apnpql_jax.render.texture import Texture
from apnpql_jax.types import Array

# What may differ between worlds, by MuJoCo's names and ids. The last of ngeom + 1 rows
# is the background.
FIELDS = (
  "geom_size",  # f32[*b, ngeom, 3]: MuJoCo half sizes, m
  "geom_rgba",  # f32[*b, ngeom, 4]: as of ``colors.geom_rgba``; alpha is ignored
  "waves",  # f32[*b, ngeom + 1, 3, 4]: see ``texture``; requires the next two
  "odd_rgb",  # f32[*b, ngeom + 1, 3]: color of odd squares
  "grain",  # f32[*b, ngeom + 1]: largest share of the brightness that noise removes
  "light_dir",  # f32[*b, nlight, 3]: direction of travel, of any length
  "light_ambient",  # f32[*b, nlight, 3]: intensity without the light, red only
  "light_diffuse",  # f32[*b, nlight, 3]: intensity added at normal incidence, red only
  "cam_fovy",  # f32[*b, ncam]: vertical field of view, degrees
  "background",  # f32[*b, 3]: color of rays that hit nothing
)


class Appearance(NamedTuple):
  """Appearance of one world; NumPy arrays are the same in all worlds."""

  sizes: Array | np.ndarray  # f32[n, 3]: of the n drawn geoms, m
  palette: Array | np.ndarray  # f32[2 n + 2, 3]: geoms, background, their odd colors
  texture: Texture | None  # None: as in the scene file
  light: Array | np.ndarray  # f32[3, 3]: see ``shadow.light_basis``
  ambient: Array | float
  diffuse: Array | float
  zoom: Array | None  # f32[]: see ``intersect.zoom_rays``; None: not zoomed


def make_appearance(
  geoms: Geoms, camera: CameraSpec, lighting: Lighting, fields: Mapping[str, Array]
) -> Appearance:
  """Builds the appearance of one world from ``FIELDS`` without leading axes."""

  def pick(name: str, index: Any, default: Any) -> Any:
    return fields[name][index] if name in fields else default

  ids, light = geoms.ids, lighting.id
  colors = pick("geom_rgba", np.s_[ids, :3], geoms.colors)
  background = pick("background", None, np.array([lighting.background], np.float32))
  odd = _concatenate(geoms.checker_colors, background)
  texture = None
  if "waves" in fields:
    rows = np.append(ids, -1)
    texture = Texture(fields["waves"][rows], fields["grain"][rows])
    odd = fields["odd_rgb"][rows]
  basis = light_basis(lighting.direction)
  zoom = None
  if "light_dir" in fields:
    basis = light_basis(fields["light_dir"][light], jnp)
  if "cam_fovy" in fields:
    default = np.tan(np.radians(camera.fovy_deg) / 2.0)
    zoom = jnp.tan(jnp.radians(fields["cam_fovy"][camera.id]) / 2.0) / default
  return Appearance(
    sizes=pick("geom_size", ids, geoms.sizes),
    palette=_concatenate(colors, background, odd),
    texture=texture,
    light=basis,
    ambient=pick("light_ambient", (light, 0), lighting.ambient),
    diffuse=pick("light_diffuse", (light, 0), lighting.diffuse),
    zoom=zoom,
  )


def _concatenate(*parts: Array | np.ndarray) -> Array | np.ndarray:
  constant = all(isinstance(part, np.ndarray) for part in parts)
  return (np if constant else jnp).concatenate(parts)
