"""MuJoCo's OpenGL renderer behind the two cameras of the agent.

It draws off screen, with EGL or OSMesa. The images are rendered larger, with the same
field of view, and resized by area.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.colors import geom_rgba, material_rgba
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.graphics import View
from apnpql_jax.sim.scene import Scene, compile_file
from apnpql_jax.transfer import looks
from apnpql_jax.transfer.graphics import (
  CAMERAS,
  color_bytes,
  developed,
  light_of,
  rendered_sizes,
)

SHADOW_SIZE = 512
"""Side of shadow maps in pixels."""

_LAMP = "transfer_lamp"
_WALLS_M = 4.0  # distance of the backdrop, m
_VARIED = ("geom_rgba", "geom_size", "geom_matid", "cam_fovy")
"""Fields of the model that differ between worlds or looks."""


class OpenGLRenderer:
  """MuJoCo's OpenGL renderer, which belongs to the thread that made it.

  It draws worlds one after the other.
  """

  def __init__(self, scene: Scene, config: EnvConfig, *, unseen: Collection[str]):
    """Compiles the scene again, with lights and textures.

    Args:
      scene: The scene.
      config: Settings of the images.
      unseen: The parts of unseen looks, of ``looks.PARTS``; none for plain looks.

    Raises:
      ConfigError: No graphics library can be loaded.
    """
    self._sizes, self._unseen = rendered_sizes(config), frozenset(unseen)
    self.model = model = _with_textures(scene)
    self._plain = {name: getattr(model, name).copy() for name in _VARIED}
    self._plain["geom_rgba"] = geom_rgba(model)
    self._untextured = material_rgba(model) - geom_rgba(model)
    self._data = mujoco.MjData(model)
    mujoco.mj_forward(model, self._data)  # Places the lights.
    self._cameras = [scene.id("camera", name) for name in CAMERAS]
    self._sun = Lighting.from_model(scene.model).id
    self._lamp = model.light(_LAMP).id
    # The sun casts shadows only without the lamp: one shadow map is faster.
    model.light_castshadow[self._sun] = "lights" not in self._unseen
    self._tables, self._surfaces = (
      [model.material(_name(kind, i)).id for i in range(count)]
      for kind, count in (("table", looks.TABLES), ("surface", looks.SURFACES))
    )
    model.vis.quality.offsamples = 0  # Oversampled instead.
    model.vis.quality.shadowsize = SHADOW_SIZE
    height, width = map(int, np.max(self._sizes, axis=0))
    shadows = config.shadows or "shadows" in self._unseen
    self._view = View(model, height, width, shadows=shadows, reflections=False)

  def __enter__(self) -> OpenGLRenderer:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the graphics."""
    self._view.__exit__(*error)

  def draw(
    self,
    poses: dict[str, np.ndarray],
    fields: dict[str, np.ndarray],
    row: int,
    instant: int,
  ) -> list[np.ndarray]:
    """Returns the images u8[H, W, 3] of the global and the wrist camera.

    Args:
      poses: Those of ``Kinematics`` of one world, in m.
      fields: Its ``PhysicsState.fields``.
      row: Its row of the reset bank, which decides on unseen looks.
      instant: Instant of the episode, which decides on their noise.
    """
    for name, value in poses.items():
      target = getattr(self._data, name)
      target[...] = value.reshape(target.shape)
    look = looks.draw(row, self.model.nbody) if self._unseen else None
    background = self._light(fields, look)
    self._color(fields, look)
    images = []
    for index, camera in enumerate(self._cameras):
      pixels, depth = self._view.render(
        self._data, camera, self._sizes[index], lambda scene: self._add(scene, look)
      )
      if "clutter" not in self._unseen:  # Else walls have the color of the look.
        pixels[depth == 1.0] = color_bytes(background)
      faults = look if "camera" in self._unseen else None
      images.append(developed(pixels, faults, row, instant, index))
    return images

  def _light(self, fields: dict[str, np.ndarray], look: looks.Look | None) -> Any:
    """Sets the lights; returns the color of the background."""
    model, data = self.model, self._data
    light, look = light_of(model, fields), look if "lights" in self._unseen else None
    data.light_xdir[self._sun] = _unit(look.sun_dir) if look else light.direction
    model.vis.headlight.diffuse[:] = model.vis.headlight.specular[:] = 0
    model.vis.headlight.ambient[:] = look.ambient if look else light.ambient
    model.light_ambient[:] = 0
    model.light_specular[:] = look.specular if look else 0
    model.light_diffuse[self._sun] = look.sun_rgb if look else light.diffuse
    model.light_active[self._lamp] = look is not None
    if look is not None:
      data.light_xpos[self._lamp] = look.lamp_pos
      data.light_xdir[self._lamp] = _unit(np.array([0.5, 0.0, 0.0]) - look.lamp_pos)
      model.light_diffuse[self._lamp] = look.lamp_rgb
    return light.background

  def _color(self, fields: dict[str, np.ndarray], look: looks.Look | None) -> None:
    """Sets sizes, colors and textures, and the fields of view."""
    model = self.model
    for name, plain in self._plain.items():
      getattr(model, name)[...] = fields.get(name, plain)
    if look is not None and "surfaces" in self._unseen:
      table = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
      model.geom_rgba[table, :3] = look.table_rgb
      surfaces = np.array(self._surfaces)[look.surfaces[model.geom_bodyid]]
      model.geom_matid[:] = np.where(table, self._tables[look.table], surfaces)
    else:  # MuJoCo multiplies by the scene's textures itself.
      model.geom_rgba += self._untextured

  def _add(self, scene: mujoco.MjvScene, look: looks.Look | None) -> None:
    """Adds what an unseen look has around the workspace."""
    if look is None or "clutter" not in self._unseen:
      return
    for axis in range(2):
      for side in (-1, 1):
        pos, size = np.zeros(3), np.full(3, _WALLS_M)
        pos[axis], size[axis] = side * _WALLS_M, 0.01
        box, upright = mujoco.mjtGeom.mjGEOM_BOX, np.eye(3).ravel()
        wall = _add_geom(scene, box, size, pos, upright, look.backdrop)
        wall.emission, wall.specular = 1.0, 0.0  # It shines in its color.
    for thing in look.clutter:
      geom = _add_geom(scene, thing.shape, thing.size, thing.pos, thing.mat, thing.rgb)
      geom.matid = self._surfaces[thing.surface]


def _add_geom(
  scene: mujoco.MjvScene, shape: int, size: Any, pos: Any, mat: Any, rgb: Any
) -> mujoco.MjvGeom:
  """Adds a geom that is not in the model; sizes and positions are in m."""
  geom = scene.geoms[scene.ngeom]
  rgba = np.append(rgb, 1.0).astype(np.float32)
  mujoco.mjv_initGeom(geom, shape, size, pos, mat, rgba)
  scene.ngeom += 1
  return geom


def _with_textures(scene: Scene) -> mujoco.MjModel:
  """Compiles the scene with the lamp and the textures of unseen looks."""
  kinds: list[tuple[str, Sequence[np.ndarray], int]] = [
    ("table", [looks.table_texture(i) for i in range(looks.TABLES)], 3),
    ("surface", [looks.surface_texture(i) for i in range(looks.SURFACES)], 1),
  ]

  def edit(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_light(
      name=_LAMP,
      type=mujoco.mjtLightType.mjLIGHT_SPOT,
      pos=[0.5, 0, 1.5],
      dir=[0, 0, -1],
      cutoff=60,
      exponent=4,
      castshadow=True,
      active=False,
    )
    for kind, images, repeat in kinds:
      cube = kind == "surface"
      for i in range(len(images)):
        spec.add_texture(
          name=_name(kind, i),
          type=mujoco.mjtTexture.mjTEXTURE_CUBE
          if cube
          else mujoco.mjtTexture.mjTEXTURE_2D,
          builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
          width=looks.SIDE,
          height=looks.SIDE,
          nchannel=3,
        )
        material = spec.add_material(name=_name(kind, i), texrepeat=[repeat, repeat])
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = _name(kind, i)
        material.texuniform = not cube

  model = compile_file(scene.path, edit)
  for kind, images, _ in kinds:
    for i, image in enumerate(images):
      start = model.tex_adr[model.texture(_name(kind, i)).id]
      model.tex_data[start : start + image.size] = image.ravel()
  # The first variant may differ from the file.
  model.geom_size[:], model.geom_rgba[:] = scene.model.geom_size, scene.model.geom_rgba
  return model


def _name(kind: str, index: int) -> str:
  return f"transfer_{kind}_{index}"


def _unit(vector: Any) -> np.ndarray:
  return np.asarray(vector) / np.linalg.norm(vector)
