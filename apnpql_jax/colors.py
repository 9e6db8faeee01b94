"""Colors of a model's geoms, from their materials and textures; no JAX."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np


class Texture(NamedTuple):
  """Factors on a geom's color: two for a checker, else the texture's mean twice."""

  edge: float  # of a checker's squares, m; 0 for any other texture
  even: np.ndarray  # f64[3]: of squares where floor(x) + floor(y) is even
  odd: np.ndarray  # f64[3]: of the others


def geom_rgba(model: mujoco.MjModel) -> np.ndarray:
  """Returns the colors that geoms show, f32[ngeom, 4], on checkers the even squares."""
  rgba = material_rgba(model)
  for geom in range(model.ngeom):
    if (texture := read_texture(model, geom)) is not None:
      rgba[geom, :3] *= texture.even
  return rgba


def material_rgba(model: mujoco.MjModel) -> np.ndarray:
  """Returns f32[ngeom, 4]: as in MuJoCo, a material replaces only the default rgba."""
  rgba = model.geom_rgba.copy()
  default = np.all(rgba == np.array([0.5, 0.5, 0.5, 1.0], rgba.dtype), axis=1)
  use_material = (model.geom_matid >= 0) & default
  rgba[use_material] = model.mat_rgba[model.geom_matid[use_material]]
  return rgba


def read_texture(model: mujoco.MjModel, geom: int) -> Texture | None:
  """Returns the texture of a geom, if any."""
  material, role = model.geom_matid[geom], mujoco.mjtTextureRole.mjTEXROLE_RGB
  texture = model.mat_texid[material, role] if material >= 0 else -1
  if texture < 0:
    return None
  height, width = model.tex_height[texture], model.tex_width[texture]
  channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
  data = model.tex_data[start : start + height * width * channels]
  data = data.reshape(height, width, channels)[..., :3]
  odd, even = data[height // 4, width // 4], data[height // 4, 3 * width // 4]
  row, column = np.arange(height) * 2 // height, np.arange(width) * 2 // width
  expected = np.where(((row[:, None] + column) % 2 == 0)[..., None], odd, even)
  size = model.geom_size[geom, :2]
  scale = np.where((size > 0) & ~model.mat_texuniform[material], size, 1.0)
  scale = scale / model.mat_texrepeat[material]
  plane = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
  if plane and np.array_equal(data, expected) and scale[0] == scale[1]:
    return Texture(float(scale[0]), even / 255.0, odd / 255.0)
  mean = data.mean((0, 1)) / 255.0
  return Texture(0.0, mean, mean)
