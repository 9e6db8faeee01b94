"""Visual shapes of PyBullet for MuJoCo's geoms.

PyBullet shades its own cylinders and capsules like other shapes: a flat disc looks like
a cone. Everything round is therefore a mesh here.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_TABLE = 4.0  # m, half the side of the square that stands for a plane
_REPEAT = 1.5  # textures of the table per meter, about as in ``opengl_renderer``
_SIDES, _RINGS = 20, 5  # of round shapes, around and from the equator to a pole


def visual_shape(client: Any, kind: int, size: np.ndarray) -> dict[str, Any]:
  """Returns the arguments of ``createVisualShape`` for a geom's type and size."""
  kinds, radius, half = mujoco.mjtGeom, float(size[0]), float(size[1])
  if kind == kinds.mjGEOM_BOX:
    return {"shapeType": client.GEOM_BOX, "halfExtents": size.tolist()}
  if kind == kinds.mjGEOM_PLANE:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    points, normals = _TABLE * corners, np.tile([0.0, 0.0, 1.0], (4, 1))
    faces, uvs = [0, 1, 2, 0, 2, 3], _REPEAT * _TABLE * (corners[:, :2] + 1)
  elif kind == kinds.mjGEOM_CYLINDER:
    outline = [(0, half), (radius, half), (radius, half)]
    outline += [(r, -z) for r, z in reversed(outline)]
    slopes = [(0, 1), (0, 1), (1, 0), (1, 0), (0, -1), (0, -1)]
    points, normals, faces, uvs = _turned(np.array(outline), np.array(slopes))
  else:
    tilt = np.linspace(0, np.pi, 2 * _RINGS)
    slopes = np.stack([np.sin(tilt), np.cos(tilt)], -1)
    if kind == kinds.mjGEOM_ELLIPSOID:
      points, normals, faces, uvs = _turned(slopes, slopes)
      points, normals = points * size, normals / size
      normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    else:
      outline = radius * slopes
      if kind == kinds.mjGEOM_CAPSULE:
        outline[:, 1] += half * np.sign(slopes[:, 1])
      points, normals, faces, uvs = _turned(outline, slopes)
  return {
    "shapeType": client.GEOM_MESH,
    "vertices": points.tolist(),
    "indices": faces,
    "uvs": uvs.tolist(),
    "normals": normals.tolist(),
  }


def _turned(
  outline: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[int], np.ndarray]:
  """Turns an outline about the z axis.

  Args:
    outline: Distances from the axis and heights f64[n, 2], from the top, m.
    slopes: Normals f64[n, 2] there.

  Returns:
    Points, normals, triangles and texture coordinates.
  """
  turn = np.linspace(0, 2 * np.pi, _SIDES + 1)
  around = np.stack([np.cos(turn), np.sin(turn)], -1)

  def spread(pairs: np.ndarray) -> np.ndarray:
    flat = pairs[:, None, :1] * around
    height = np.broadcast_to(pairs[:, None, 1:], (*flat.shape[:2], 1))
    return np.concatenate([flat, height], -1).reshape(-1, 3).astype(float)

  faces = []
  for row in range(len(outline) - 1):
    for side in range(_SIDES):
      a = row * (_SIDES + 1) + side
      b = a + _SIDES + 1
      faces += [a, b, a + 1, a + 1, b, b + 1]
  down, across = np.meshgrid(np.linspace(0, 1, len(outline)), turn, indexing="ij")
  uvs = np.stack([across / (2 * np.pi), down], -1).reshape(-1, 2)
  return spread(outline), spread(slopes), faces, uvs
