"""Static description of what the ray caster draws: geoms, cameras and light.

Everything here is NumPy or plain Python, read once from a ``mujoco.MjModel`` and
constant in the compiled program, whose only arguments are poses and fields.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
import dataclasses
import functools
from typing import Any

import mujoco
import numpy as np

from apnpql_jax import colors
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError
from apnpql_jax.render.hull import LEAST_FILL, THIN, hull_of
from apnpql_jax.render.intersect import HITS


@dataclasses.dataclass(frozen=True, eq=False)
class Geoms:
  """The n visible geoms of a model by type and MuJoCo id; hashed by identity."""

  ids: np.ndarray  # i32[n]: MuJoCo geom ids
  types: np.ndarray  # i32[n]: ``mujoco.mjtGeom``, sorted
  sizes: np.ndarray  # f32[n, 3]: MuJoCo half sizes, m
  colors: np.ndarray  # f32[n, 3]: RGB in [0, 1]; every visible geom is drawn opaque
  checker: np.ndarray  # f32[n]: edge of a checker's squares, m; 0 for a plain geom
  checker_colors: np.ndarray  # f32[n, 3]: of squares where floor(x) + floor(y) is odd
  hulls: dict[int, np.ndarray]  # row of a mesh -> planes f32[k, 4], see ``hull``

  @classmethod
  def from_model(
    cls, model: mujoco.MjModel, groups: Sequence[int] = (0, 1, 2)
  ) -> Geoms:
    """Reads the visible geoms: alpha above zero; default groups as in MuJoCo's viewer.

    A mesh is drawn as its convex hull. A texture other than a checker on a plane is
    drawn as its mean color, which one line reports.

    Raises:
      ConfigError: A visible geom is of another type, or a mesh that fills too little of
        its hull.
    """
    rgba, untextured = colors.geom_rgba(model), colors.material_rgba(model)
    ids = np.flatnonzero((rgba[:, 3] > 0) & np.isin(model.geom_group, groups))
    ids = ids[np.argsort(model.geom_type[ids], kind="stable")]
    checker, odd_colors = np.zeros(len(ids)), np.zeros((len(ids), 3))
    sizes = model.geom_size[ids].copy()
    hulls = {}
    for k, i in enumerate(ids):
      _check_type(model, i)
      if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH:
        hulls[k] = _read_hull(model, i)
        sizes[k] = np.maximum(sizes[k], THIN)
      if (texture := colors.read_texture(model, i)) is not None:
        checker[k], odd_colors[k] = texture.edge, untextured[i, :3] * texture.odd
        if not texture.edge:
          _print_once(f"the texture of {_title(model, i)} is drawn as its mean color")
    return cls(
      ids=ids.astype(np.int32),
      types=model.geom_type[ids].astype(np.int32),
      sizes=sizes.astype(np.float32),
      colors=rgba[ids, :3],
      checker=checker.astype(np.float32),
      checker_colors=odd_colors.astype(np.float32),
      hulls=hulls,
    )

  def rows(self, ids: Sequence[int], types: Container[int]) -> list[int]:
    """Returns the rows of geoms, given by MuJoCo id, that take part in shadows."""
    rows = {int(i): k for k, i in enumerate(self.ids) if int(self.types[k]) in types}
    if wrong := [i for i in ids if i not in rows]:
      raise ValueError(
        f"geoms {wrong} cannot take part in shadows; valid: {sorted(rows)}"
      )
    return [rows[i] for i in ids]


@dataclasses.dataclass(frozen=True)
class CameraSpec:
  """A perspective camera: looks along -z of its frame, +x right, +y up."""

  name: str
  id: int
  height: int  # pixels
  width: int  # pixels; they are square, so it sets the horizontal field of view
  fovy_deg: float  # vertical field of view in degrees, as in MJCF

  @classmethod
  def from_model(
    cls, model: mujoco.MjModel, name: str, *, height: int, width: int
  ) -> CameraSpec:
    """Reads a camera by name.

    Raises:
      ConfigError: The camera is missing or not plain perspective, or the image is
        empty.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
      raise ConfigError(f"no camera {name!r} in the model (valid: {names})")
    if height < 1 or width < 1:
      raise ConfigError(f"image of camera {name!r} is empty: {height}x{width}")
    i = names.index(name)
    perspective = mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    if model.cam_projection[i] != perspective or model.cam_sensorsize[i].any():
      raise ConfigError(f"camera {name!r} must be perspective and set by fovy alone")
    return cls(name, i, height, width, float(model.cam_fovy[i]))


@dataclasses.dataclass(frozen=True)
class Lighting:
  """Ambient light, one directional light, background and shadows.

  Intensity on a surface with unit normal n, where l points toward the light, is
  ``ambient + diffuse * max(n.l, -fill * n.l)``; without ``fill`` all surfaces that face
  away would have one flat color. Seen from the light, every shadow receiver must lie
  behind every caster, as a table lies under a gripper. No casters, no cost.
  """

  direction: tuple[float, float, float] = (0.3, 0.4, -1.0)  # of travel, of any length
  ambient: float = 0.35  # intensity without the light
  diffuse: float = 0.65  # intensity added at normal incidence
  fill: float = 0.3  # share of ``diffuse`` on surfaces that face straight away
  background: tuple[float, float, float] = (0.55, 0.65, 0.75)  # color without a hit
  shadow_casters: tuple[int, ...] = ()  # MuJoCo ids of spheres, capsules and boxes
  shadow_receivers: tuple[int, ...] = ()  # MuJoCo ids of drawn geoms
  shadow: float = 0.4  # share of the intensity that a shadow removes
  id: int = 0  # MuJoCo id of the light, for fields that differ between worlds

  def __post_init__(self):
    shares = (self.ambient, self.diffuse, self.fill, self.shadow, *self.background)
    if any(not 0.0 <= x <= 1.0 for x in shares) or self.ambient + self.diffuse > 1.0:
      raise ValueError(
        "light intensities must lie in [0, 1] and ambient + diffuse must not exceed 1, "
        f"got {self}"
      )
    if not np.any(self.direction):
      raise ValueError("the light direction must not be zero")
    if set(self.shadow_casters) & set(self.shadow_receivers):
      raise ValueError("a geom cannot both cast and receive shadows")

  @classmethod
  def from_model(cls, model: mujoco.MjModel, **settings: Any) -> Lighting:
    """Takes the direction of the model's light; ``settings`` are other fields.

    Raises:
      ConfigError: There is not exactly one directional light, or a body carries it.
    """
    lights = np.flatnonzero(model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    if len(lights) != 1 or model.light_bodyid[lights[0]] != 0:
      names = [model.light(i).name or f"light {i}" for i in lights]
      raise ConfigError(
        "the scene needs exactly one directional light, in the world; it has "
        f"{', '.join(names) or 'none'} (arena.xml brings sun)"
      )
    x, y, z = model.light_dir[lights[0]].tolist()
    return cls(direction=(x, y, z), id=int(lights[0]), **settings)


def _read_hull(model: mujoco.MjModel, geom_id: int) -> np.ndarray:
  """Returns the planes of a mesh that looks like its convex hull."""
  planes, fill = hull_of(model, geom_id)
  if fill < LEAST_FILL:
    raise ConfigError(
      f"cannot draw mesh {_title(model, geom_id)}: it fills {fill:.0%} of its convex "
      "hull, and a mesh is drawn as its hull. Split it into convex meshes, draw "
      'primitives and hide it with group="3", or use --obs state'
    )
  return planes


def _title(model: mujoco.MjModel, geom_id: int) -> str:
  return repr(model.geom(geom_id).name or f"geom {geom_id}")


def _check_type(model: mujoco.MjModel, geom_id: int) -> None:
  kind = int(model.geom_type[geom_id])
  valid = (*HITS, int(mujoco.mjtGeom.mjGEOM_MESH))
  if kind not in valid:
    found, *names = (
      mujoco.mjtGeom(x).name.removeprefix("mjGEOM_").lower() for x in (kind, *valid)
    )
    raise ConfigError(
      f"cannot draw {_title(model, geom_id)}: it is of type {found} (valid: "
      f'{", ".join(names)}); replace it, hide it with group="3", or use --obs state'
    )


@functools.cache
def _print_once(line: str) -> None:
  print_line(line)
