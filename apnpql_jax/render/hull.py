"""Convex hulls of meshes, which stand in for them in images.

MuJoCo collides meshes as their convex hulls too. A hull with many facets is replaced by
a polyhedron with fewer, of the same volume.
"""

from __future__ import annotations

import mujoco
import numpy as np

MOST_PLANES = 48
"""Planes per hull; a plane costs about a third of a box."""

THIN = 1e-4
"""Least half size of a drawn mesh, m."""

LEAST_FILL = 0.8
"""Share of its hull that a mesh must fill to be drawn as it."""


def hull_of(model: mujoco.MjModel, geom_id: int) -> tuple[np.ndarray, float]:
  """Returns the hull of a mesh geom and the share of its volume that the mesh fills.

  Returns:
    Planes f32[k, 4], k <= MOST_PLANES: outward unit normal n and offset d of
    n . (x / size) <= d, with x in the geom's frame and its sizes. The share is that of
    the signed volume of the mesh, which is smaller for a mesh that is not closed.
  """
  from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

  mesh = model.geom_dataid[geom_id]
  start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
  first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
  vertices = model.mesh_vert[start : start + count].astype(np.float64)
  points = vertices / np.maximum(model.geom_size[geom_id], THIN)
  try:
    found = ConvexHull(points)
  except QhullError:  # It is flat, and so is its box.
    box = _touching(np.concatenate([np.eye(3), -np.eye(3)]), points)
    box[box[:, 3] == 0.0, 3] = 1.0
    return box, 1.0
  a, b, c = np.moveaxis(points[model.mesh_face[first : first + faces]], 1, 0)
  volume = abs((a * np.cross(b, c)).sum()) / 6.0
  corners = points[found.simplices]
  edges = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
  areas = np.linalg.norm(edges, axis=1) / 2.0
  normals = _spread(found.equations[:, :3], areas)
  planes, center = _touching(normals, points), points[found.vertices].mean(0)
  if len(normals) == MOST_PLANES:  # Planes that touch it enclose more than it.
    halfspaces = planes * [1, 1, 1, -1]
    outer = ConvexHull(HalfspaceIntersection(halfspaces, center).intersections)
    middle = planes[:, :3] @ center
    planes[:, 3] -= middle
    planes[:, 3] *= (found.volume / outer.volume) ** (1 / 3)
    planes[:, 3] += middle
  return planes, float(volume / found.volume)


def _spread(normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
  """Returns up to ``MOST_PLANES`` normals: of large facets, then those farthest apart.

  Triangles of one facet share a normal, which is returned once.
  """
  keys = np.round(normals, 4) + 0.0
  _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
  area, unique = np.bincount(index.reshape(-1), weights=areas), normals[first]
  if len(unique) <= MOST_PLANES:
    return unique
  large = np.argsort(-area)[: MOST_PLANES // 2]
  chosen = [int(i) for i in large if area[i] > 0.02 * area.sum()] or [int(large[0])]
  while len(chosen) < MOST_PLANES:
    nearest = (unique @ unique[chosen].T).max(axis=1)
    chosen.append(int(nearest.argmin()))
  return unique[chosen]


def _touching(normals: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Returns the planes f32[k, 4] with these normals that touch the points."""
  offsets = (points @ normals.T).max(axis=0)
  return np.concatenate([normals, offsets[:, None]], axis=1).astype(np.float32)
