"""Points on the surfaces of geoms, their meshes, and the hand at other poses."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection

from apnpql_jax.envs.cameras import in_hand
from apnpql_jax.render import Geoms
from apnpql_jax.render.hull import THIN
from apnpql_jax.sim.scene import Scene

_KIND = mujoco.mjtGeom
_TURNS, _RINGS = 20, 6
"""Points around a round shape, and rings on each half of a sphere."""


def surface(kind: int, size: np.ndarray) -> np.ndarray:
  """Returns points f64[n, 3] (m) whose convex hull is a geom, in its frame.

  ``kind`` and ``size`` are MuJoCo's; a plane has no such points, and those of a mesh
  are its ``corners``.
  """
  x, y, z = (float(value) for value in size)
  if kind == _KIND.mjGEOM_BOX:
    corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    return corners * [x, y, z]
  if kind == _KIND.mjGEOM_CYLINDER:
    ring = _ring() * x
    return np.concatenate([np.c_[ring, np.full(_TURNS, h)] for h in (-y, y)])
  ball = _ball()
  if kind == _KIND.mjGEOM_SPHERE:
    return ball * x
  if kind == _KIND.mjGEOM_ELLIPSOID:
    return ball * [x, y, z]
  if kind == _KIND.mjGEOM_CAPSULE:
    shift = np.array([0.0, 0.0, y])
    return np.concatenate([ball * x - shift, ball * x + shift])
  raise ValueError(f"a geom of kind {kind} has no convex hull")


def corners(planes: np.ndarray, size: np.ndarray) -> np.ndarray:
  """Returns the corners f64[n, 3] (m) of a mesh's hull as images have it.

  Args:
    planes: Planes f32[k, 4] in sizes, see ``render.hull``; the origin, which is the
      center of mass, is inside.
    size: Sizes of the geom f[3], m.
  """
  halfspaces = planes.astype(np.float64) * [1, 1, 1, -1]
  inside = HalfspaceIntersection(halfspaces, np.zeros(3))
  return inside.intersections * np.maximum(size, THIN)


def mesh(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns vertices f32[v, 3] and outward faces u32[f, 3] of a convex hull."""
  hull = ConvexHull(points)
  index = np.full(len(points), -1)
  index[hull.vertices] = np.arange(len(hull.vertices))
  vertices, faces = points[hull.vertices], index[hull.simplices]
  a, b, c = (vertices[faces[:, i]] for i in range(3))
  inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(-1) < 0
  faces[inward] = faces[inward][:, ::-1]
  return vertices.astype(np.float32), faces.astype(np.uint32)


class GhostHand:
  """The hand of the robot at another pose of the tool."""

  def __init__(self, scene: Scene, sizes: np.ndarray):
    """Takes the shapes of the hand; ``sizes`` are those of all geoms, f[ngeom, 3]."""
    self._tool, model = scene.tool_site, scene.model
    drawn = Geoms.from_model(model).ids
    self._geoms = np.intersect1d(drawn, np.flatnonzero(in_hand(scene)))
    self._surfaces = [surface(model.geom_type[i], sizes[i]) for i in self._geoms]

  def parts(self, poses: Any) -> list[np.ndarray]:
    """Returns points whose hulls make up the hand, f64[n, 3] each, in its tool's frame.

    The fingers are as they are at present.
    """
    origin, turn = poses.site_xpos[self._tool], poses.site_xmat[self._tool]
    return [
      (points @ poses.geom_xmat[i].T + poses.geom_xpos[i] - origin) @ turn
      for i, points in zip(self._geoms, self._surfaces, strict=True)
    ]


def _ring() -> np.ndarray:
  angle = np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
  return np.stack([np.cos(angle), np.sin(angle)], -1)


def _ball() -> np.ndarray:
  latitude = np.linspace(-np.pi / 2, np.pi / 2, 2 * _RINGS + 1)
  rings = [np.c_[_ring() * np.cos(a), np.full(_TURNS, np.sin(a))] for a in latitude]
  return np.concatenate(rings)
