"""How a world looks, where that may differ between worlds.

``Geoms``, ``CameraSpec`` and ``Lighting`` say it for all worlds alike; a field takes
the place of what they say. What no field touches stays a constant of the program.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.render.geoms import CameraSpec, Geoms, Lighting
from apnpql_jax.render.shadow import light_basis
from apnpql_jax.render.texture import Texture

Array = jax.Array

FIELDS = (
  "geom_size",  # f32[*b, ngeom, 3]: MuJoCo half sizes, m
  "geom_rgba",  # f32[*b, ngeom, 4]: of which alpha does not count
  "waves",  # f32[*b, ngeom + 1, 3, 4]: see ``texture``; with them the next two
  "odd_rgb",  # f32[*b, ngeom + 1, 3]: the other color
  "grain",  # f32[*b, ngeom + 1]: share of the brightness that noise takes at most
  "light_dir",  # f32[*b, nlight, 3]: in which a light travels, of any length
  "light_ambient",  # f32[*b, nlight, 3]: intensity in the dark; the first of the three
  "light_diffuse",  # f32[*b, nlight, 3]: intensity straight below; the first, too
  "cam_fovy",  # f32[*b, ncam]: vertical field of view, degrees
  "background",  # f32[*b, 3]: color of rays that hit nothing
)
"""What may differ between worlds, by MuJoCo's names and by MuJoCo's ids; where there is
one more than geoms, the last is the background."""


class Appearance(NamedTuple):
  """One world; NumPy where it is the same in all."""

  sizes: Array | np.ndarray  # f32[n, 3]: of the n geoms that are drawn, m
  palette: Array | np.ndarray  # f32[2 n + 2, 3]: geoms, background, their odd colors
  texture: Texture | None  # None: as in the scene file
  light: Array | np.ndarray  # f32[3, 3]: see ``shadow.light_basis``
  ambient: Array | float
  diffuse: Array | float
  zoom: Array | None  # f32[]: see ``intersect.zoomed``; None for none


def make_appearance(
  geoms: Geoms, camera: CameraSpec, lighting: Lighting, fields: Mapping[str, Array]
) -> Appearance:
  """The look of one world.

  Args:
    geoms: what to draw.
    camera: whose field of view counts.
    lighting: light and background.
    fields: some of ``FIELDS``, without leading axes.
  """
  ids, light = geoms.ids, lighting.id
  colors, texture = geoms.colors, None
  if "geom_rgba" in fields:
    colors = fields["geom_rgba"][ids, :3]
  background = np.array([lighting.background], np.float32)
  if "background" in fields:
    background = fields["background"][None]
  odd = _join(geoms.checker_colors, background)
  if "waves" in fields:
    things = np.append(ids, -1)
    texture = Texture(fields["waves"][things], fields["grain"][things])
    odd = fields["odd_rgb"][things]
  basis, ambient, diffuse = None, lighting.ambient, lighting.diffuse
  if "light_dir" in fields:
    basis = light_basis(fields["light_dir"][light], jnp)
  if "light_ambient" in fields:
    ambient = fields["light_ambient"][light, 0]
  if "light_diffuse" in fields:
    diffuse = fields["light_diffuse"][light, 0]
  return Appearance(
    sizes=fields["geom_size"][ids] if "geom_size" in fields else geoms.sizes,
    palette=_join(colors, background, odd),
    texture=texture,
    light=light_basis(lighting.direction) if basis is None else basis,
    ambient=ambient,
    diffuse=diffuse,
    zoom=_zoom(camera, fields["cam_fovy"]) if "cam_fovy" in fields else None,
  )


def _join(*parts: Array | np.ndarray) -> Array | np.ndarray:
  constant = all(isinstance(part, np.ndarray) for part in parts)
  return (np if constant else jnp).concatenate(parts)


def _zoom(camera: CameraSpec, fovy: Array) -> Array:
  own = np.tan(np.radians(camera.fovy_deg) / 2.0)
  return jnp.tan(jnp.radians(fovy[camera.id]) / 2.0) / own
