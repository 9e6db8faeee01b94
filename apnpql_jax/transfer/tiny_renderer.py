"""PyBullet's TinyRenderer behind the two cameras of the agent.

It draws on the CPU, without a graphics library. Every geom is a body of its own, at the
poses of MuJoCo's kinematics, so that it draws worlds of any physics. One light shines,
and surfaces have no checkers or waves. Images are rendered larger and resized by area,
as those of ``opengl_renderer``.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from pathlib import Path
import tempfile
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from apnpql_jax.colors import geom_rgba
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.render import Geoms
from apnpql_jax.sim.scene import Scene
from apnpql_jax.training.evaluate import MAX_WORLDS
from apnpql_jax.transfer import looks
from apnpql_jax.transfer.bullet import connect
from apnpql_jax.transfer.graphics import (
  CAMERAS,
  color_bytes,
  developed,
  field_of,
  light_of,
  rendered_sizes,
)
from apnpql_jax.transfer.visual_shapes import visual_shape

KEPT = MAX_WORLDS
"""Worlds that stay loaded: as many as are played in parallel."""

_NEAR, _FAR = 0.01, 10.0  # m
_LIGHT_M = 3.0  # m, where the light stands for its shadows


class TinyRenderer:
  """PyBullet's TinyRenderer, which draws worlds one after the other."""

  def __init__(self, scene: Scene, config: EnvConfig, *, unseen: Collection[str]):
    """Prepares the textures; the arguments are those of ``OpenGLRenderer``.

    Raises:
      ConfigError: The scene has meshes.
    """
    self._sizes = rendered_sizes(config)
    self._model, self._geoms = scene.model, Geoms.from_model(scene.model)
    self._rgba = geom_rgba(scene.model)
    if (self._geoms.types == mujoco.mjtGeom.mjGEOM_MESH).any():
      raise ConfigError(f"{scene.name}.xml has meshes, which --renderer tiny lacks")
    self._cameras = [scene.id("camera", name) for name in CAMERAS]
    self._unseen = frozenset(unseen)
    self._shadows = config.shadows or "shadows" in self._unseen
    self._worlds: OrderedDict[Any, _World] = OrderedDict()
    self._textures = tempfile.TemporaryDirectory()

  def __enter__(self) -> TinyRenderer:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the simulators and the files of textures."""
    for world in self._worlds.values():
      world.client.disconnect()
    self._textures.cleanup()

  def draw(
    self,
    poses: dict[str, np.ndarray],
    fields: dict[str, np.ndarray],
    row: int,
    instant: int,
  ) -> list[np.ndarray]:
    """Returns the images u8[H, W, 3] of the global and the wrist camera.

    The arguments are those of ``OpenGLRenderer.draw``.
    """
    look = looks.draw(row, self._model.nbody) if self._unseen else None
    world = self._world_of(field_of(self._model, fields, "geom_size"), row, look)
    world.place(poses["geom_xpos"], poses["geom_xmat"])
    if "surfaces" not in self._unseen:
      world.color(np.asarray(fields.get("geom_rgba", self._rgba)))
    background, lighting = self._lighting(fields, look)
    faults = look if "camera" in self._unseen else None
    angles, images = field_of(self._model, fields, "cam_fovy"), []
    for index, camera in enumerate(self._cameras):
      eye, mat = (poses[name][camera] for name in ("cam_xpos", "cam_xmat"))
      pixels = world.image(
        self._sizes[index], eye, np.reshape(mat, (3, 3)), angles[camera], lighting
      )
      pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3], color_bytes(background))
      images.append(developed(pixels.astype(np.uint8), faults, row, instant, index))
    return images

  def _lighting(
    self, fields: dict[str, np.ndarray], look: looks.Look | None
  ) -> tuple[Any, dict[str, Any]]:
    """Returns the color of the background, and arguments of ``getCameraImage``."""
    light = light_of(self._model, fields)
    background, direction = light.background, light.direction
    color, ambient, diffuse = [1.0, 1.0, 1.0], light.ambient, light.diffuse
    if look is not None and "clutter" in self._unseen:
      background = look.backdrop
    look = look if "lights" in self._unseen else None
    if look is not None:
      direction, ambient = look.sun_dir, look.ambient
      diffuse = float(look.sun_rgb.max())
      color = (look.sun_rgb / diffuse).tolist()
    return background, {
      "lightDirection": (-direction).tolist(),
      "lightColor": color,
      "lightAmbientCoeff": ambient,
      "lightDiffuseCoeff": diffuse,
      "lightSpecularCoeff": look.specular if look else 0.0,
      "lightDistance": _LIGHT_M,
      "shadow": int(self._shadows),
    }

  def _world_of(
    self, sizes: np.ndarray, row: int | None, look: looks.Look | None
  ) -> _World:
    """Returns the simulator with the shapes of a world."""
    key = row if look else None, sizes.tobytes()
    if key not in self._worlds:
      if len(self._worlds) >= KEPT:
        self._worlds.popitem(last=False)[1].client.disconnect()
      folder = Path(self._textures.name)
      self._worlds[key] = _World(
        self._model,
        self._geoms,
        sizes,
        folder,
        surfaces=look if "surfaces" in self._unseen else None,
        clutter=look if "clutter" in self._unseen else None,
      )
    self._worlds.move_to_end(key)
    return self._worlds[key]


class _World:
  """A simulator that holds the visible geoms of a world, each as a body."""

  def __init__(
    self,
    model: mujoco.MjModel,
    geoms: Geoms,
    sizes: np.ndarray,
    folder: Path,
    *,
    surfaces: looks.Look | None = None,
    clutter: looks.Look | None = None,
  ):
    self.client = connect()
    self._folder, self._ids, self._colors = folder, geoms.ids, {}
    self._files: dict[str, int] = {}
    self._bodies = []
    for geom, kind, rgb in zip(geoms.ids, geoms.types, geoms.colors, strict=True):
      kind, texture = int(kind), None
      if surfaces and kind == mujoco.mjtGeom.mjGEOM_PLANE:
        rgb, texture = surfaces.table_rgb, ("table", surfaces.table)
      elif surfaces:
        texture = "surface", int(surfaces.surfaces[model.geom_bodyid[geom]])
      self._bodies.append(self._add(kind, sizes[geom], rgb, texture))
    for thing in clutter.clutter if clutter else ():
      body = self._add(thing.shape, thing.size, thing.rgb, ("surface", thing.surface))
      self._put(body, thing.pos, thing.mat)

  def place(self, pos: np.ndarray, mat: np.ndarray) -> None:
    """Moves the geoms to positions f64[ngeom, 3], m, and rotations f64[ngeom, 9]."""
    for body, geom in zip(self._bodies, self._ids, strict=True):
      self._put(body, pos[geom], mat[geom])

  def color(self, rgba: np.ndarray) -> None:
    """Changes the colors of geoms to rgba f32[ngeom, 4], in [0, 1]."""
    for body, geom in zip(self._bodies, self._ids, strict=True):
      color = (*rgba[geom, :3].tolist(), 1.0)
      if self._colors.get(body) != color:
        self.client.changeVisualShape(body, -1, rgbaColor=color)
        self._colors[body] = color

  def image(
    self,
    size: tuple[int, int],
    eye: np.ndarray,
    mat: np.ndarray,
    fovy: float,
    lighting: dict[str, Any],
  ) -> np.ndarray:
    """Returns RGB and whether something is there, u8[H, W, 4].

    Args:
      size: Height and width in pixels.
      eye: Position of the camera f64[3], m.
      mat: Its rotation f64[3, 3], in MuJoCo's convention.
      fovy: Vertical field of view, degrees.
      lighting: Arguments of ``getCameraImage``.
    """
    client, (height, width) = self.client, size
    ahead, up = eye - mat[:, 2], mat[:, 1]
    lens = (float(fovy), width / height, _NEAR, _FAR)
    *_, picture, _, segments = client.getCameraImage(
      width,
      height,
      client.computeViewMatrix(eye.tolist(), ahead.tolist(), up.tolist()),
      client.computeProjectionMatrixFOV(*lens),
      renderer=client.ER_TINY_RENDERER,
      **lighting,
    )
    image = np.reshape(np.asarray(picture, np.uint8), (height, width, 4)).copy()
    image[..., 3] = np.reshape(segments, (height, width)) >= 0
    return image

  def _add(
    self, kind: int, size: np.ndarray, rgb: Any, texture: tuple[str, int] | None
  ) -> int:
    client, rgba = self.client, [*np.asarray(rgb, float).tolist(), 1.0]
    visual = client.createVisualShape(
      rgbaColor=rgba, **visual_shape(client, kind, size)
    )
    body = client.createMultiBody(0, -1, visual)
    if texture:
      number = self._texture(*texture)
      client.changeVisualShape(body, -1, textureUniqueId=number)
    return body

  def _texture(self, kind: str, index: int) -> int:
    name = f"{kind}_{index}.png"
    if name not in self._files:
      path = self._folder / name
      if not path.exists():
        image = getattr(looks, f"{kind}_texture")(index)
        iio.imwrite(path, image[: looks.SIDE])  # One face of a cube.
      self._files[name] = self.client.loadTexture(str(path))
    return self._files[name]

  def _put(self, body: int, pos: np.ndarray, mat: np.ndarray) -> None:
    quat = Rotation.from_matrix(np.reshape(mat, (3, 3))).as_quat()
    self.client.resetBasePositionAndOrientation(body, pos.tolist(), quat.tolist())
