"""Objects that consist of overlapping boxes, as one convex shape.

MuJoCo's scenes build plates and cups of boxes about one center. Where their union is
convex, one hull has the same surface. Bullet needs it: thin pads catch between the
faces of overlapping boxes, which push in opposite directions, and never let go.
"""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

MARGIN = 0.001
"""Bullet adds it around meshes that URDF files load, m."""

_SAMPLES, _SHARE = 2000, 0.99
"""Points in the hull of which this share lies in a box, if their union is convex."""


def hull_of(model: mujoco.MjModel, body: int) -> str | None:
  """Returns a Wavefront file of the hull of a body's boxes that take part in contacts.

  None if there are less than two, other shapes, or the union is not convex.
  """
  paired = np.concatenate([model.pair_geom1, model.pair_geom2])
  first = model.body_geomadr[body]
  geoms = [g for g in range(first, first + model.body_geomnum[body]) if g in paired]
  if len(geoms) < 2 or (model.geom_type[geoms] != mujoco.mjtGeom.mjGEOM_BOX).any():
    return None
  if not _convex(model, geoms):
    return None
  points = _corners(model, geoms, shrink=MARGIN)
  faces = ConvexHull(points).simplices + 1
  lines = [f"v {x} {y} {z}" for x, y, z in points.tolist()]
  return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces.tolist())]) + "\n"


def _corners(model: mujoco.MjModel, geoms: list[int], *, shrink: float) -> np.ndarray:
  signs = np.array([*itertools.product((-1, 1), repeat=3)])
  corners = []
  for geom in geoms:
    local = signs * (model.geom_size[geom] - shrink)
    corners.append(model.geom_pos[geom] + local @ _mat(model, geom).T)
  return np.concatenate(corners)


def _convex(model: mujoco.MjModel, geoms: list[int]) -> bool:
  """Checks with random points whether the union of boxes fills its hull."""
  corners, rng = _corners(model, geoms, shrink=0.0), np.random.default_rng(0)
  planes = ConvexHull(corners).equations
  low, high = corners.min(0), corners.max(0)
  points = rng.uniform(low, high, (_SAMPLES, 3))
  points = points[(points @ planes[:, :3].T + planes[:, 3] < 0).all(1)]
  inside = np.zeros(len(points), bool)
  for geom in geoms:
    local = (points - model.geom_pos[geom]) @ _mat(model, geom)
    inside |= (np.abs(local) < model.geom_size[geom]).all(1)
  return bool(inside.mean() > _SHARE)


def _mat(model: mujoco.MjModel, geom: int) -> np.ndarray:
  mat = np.zeros(9)
  mujoco.mju_quat2Mat(mat, model.geom_quat[geom])
  return mat.reshape(3, 3)
