"""MuJoCo's OpenGL renderer behind the two cameras of the agent.

It draws off screen, with EGL or OSMesa. The images are rendered larger, with the same
field of view, and resized by area.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.graphics import area_resized, off_screen
from apnpql_jax.sim.scene import Scene, compile_file
from apnpql_jax.transfer import looks
from apnpql_jax.transfer.graphics import (
  CAMERAS,
  OVERSAMPLING,
  color_bytes,
  light_of,
)

SHADOW_SIZE = 512
"""Side of shadow maps in pixels."""

_LAMP = "transfer_lamp"
_WALLS = 4.0  # m, distance of the backdrop


class OpenGL:
  """Draws worlds one after the other; belongs to the thread that made it."""

  def __init__(self, scene: Scene, config: EnvConfig, *, unseen: bool):
    """Compiles the scene again, with lights and textures; ``unseen`` uses them.

    Raises:
      ConfigError: No graphics library can be loaded.
    """
    sizes = config.global_size, config.wrist_size
    self._sizes = [(OVERSAMPLING * h, OVERSAMPLING * w) for h, w in sizes]
    self.model = model = _with_textures(scene)
    self._plain = {
      name: getattr(model, name).copy()
      for name in ("geom_rgba", "geom_size", "geom_matid", "cam_fovy")
    }
    self._data = mujoco.MjData(model)
    mujoco.mj_forward(model, self._data)  # Places the lights.
    self._cameras = [scene.id("camera", name) for name in CAMERAS]
    self._sun = Lighting.from_model(scene.model).id
    self._lamp = model.light(_LAMP).id
    self._materials = [
      model.material(_name("table", i)).id for i in range(looks.TABLES)
    ]
    self._surfaces = [
      model.material(_name("surface", i)).id for i in range(looks.SURFACES)
    ]
    self._unseen = unseen
    model.light_castshadow[
      self._sun
    ] = not unseen  # Only the lamp does, which is faster.
    height, width = np.max(self._sizes, axis=0)
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    model.vis.quality.offsamples = 0  # Oversampled instead.
    model.vis.quality.shadowsize = SHADOW_SIZE
    self._gl = off_screen(int(width), int(height))
    self._scene = mujoco.MjvScene(model, model.ngeom + 64)
    self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = unseen or config.shadows
    self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    self._option = mujoco.MjvOption()
    self._option.sitegroup[:] = 0
    self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

  def __enter__(self) -> OpenGL:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the graphics, which the end of Python would do too late."""
    self._gl.make_current()
    self._context.free()
    self._gl.free()

  def draw(
    self,
    poses: dict[str, np.ndarray],
    fields: dict[str, np.ndarray],
    row: int,
    time: int,
  ) -> list[np.ndarray]:
    """Returns the images u8[H, W, 3] of the global and the wrist camera.

    Args:
      poses: Those of ``Kinematics`` of one world.
      fields: Its ``PhysicsState.fields``.
      row: Its row of the reset bank, which decides on unseen looks.
      time: Instant of the episode, which decides on their noise.
    """
    self._gl.make_current()
    for name, value in poses.items():
      target = getattr(self._data, name)
      target[...] = value.reshape(target.shape)
    look = looks.draw(row, self.model.nbody) if self._unseen else None
    background = self._dress(fields, look)
    images = []
    for index, (height, width) in enumerate(self._sizes):
      camera = mujoco.MjvCamera()
      camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
      camera.fixedcamid = self._cameras[index]
      mujoco.mjv_updateScene(
        self.model,
        self._data,
        self._option,
        None,
        camera,
        mujoco.mjtCatBit.mjCAT_ALL,
        self._scene,
      )
      if look:
        self._add_walls(background)
      for thing in look.clutter if look else ():
        self._add(thing.shape, thing.size, thing.pos, thing.mat, thing.rgb)
        self._scene.geoms[self._scene.ngeom - 1].matid = self._surfaces[thing.surface]
      view, pixels = (
        mujoco.MjrRect(0, 0, width, height),
        np.zeros((height, width, 3), "u1"),
      )
      mujoco.mjr_render(view, self._scene, self._context)
      depth = np.zeros((height, width), np.float32)
      mujoco.mjr_readPixels(pixels, depth, view, self._context)
      if not look:  # Walls would be lit.
        pixels[depth == 1.0] = color_bytes(background)
      image = area_resized(pixels[::-1], OVERSAMPLING)
      if look:
        rng = np.random.default_rng([looks.VERSION, row, time, index])
        image = looks.photograph(image, look, index, rng)
      images.append(image)
    return images

  def _dress(self, fields: dict[str, np.ndarray], look: looks.Look | None) -> Any:
    """Sets surfaces and lights; returns the color of the background."""
    model, data = self.model, self._data
    given = {**self._plain, **{k: x for k, x in fields.items() if k in self._plain}}
    for name in ("geom_rgba", "geom_size", "geom_matid", "cam_fovy"):
      getattr(model, name)[...] = given[name]
    light = light_of(model, fields)
    data.light_xdir[self._sun] = light.direction
    model.vis.headlight.diffuse[:] = model.vis.headlight.specular[:] = 0
    model.vis.headlight.ambient[:] = look.ambient if look else light.ambient
    model.light_ambient[:] = 0
    model.light_specular[:] = look.specular if look else 0
    model.light_diffuse[self._sun] = look.sun_rgb if look else light.diffuse
    model.light_active[self._lamp] = look is not None
    if look is None:
      return light.background
    data.light_xdir[self._sun] = _unit(look.sun_dir)
    data.light_xpos[self._lamp] = look.lamp_pos
    data.light_xdir[self._lamp] = _unit(np.array([0.5, 0.0, 0.0]) - look.lamp_pos)
    model.light_diffuse[self._lamp] = look.lamp_rgb
    table = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_rgba[table, :3] = look.table_rgb
    surfaces = np.array(self._surfaces)[look.surfaces[model.geom_bodyid]]
    model.geom_matid[:] = np.where(table, self._materials[look.table], surfaces)
    return look.backdrop

  def _add_walls(self, rgb: Any) -> None:
    """Surrounds the scene by walls that shine in one color."""
    for axis in range(2):
      for side in (-1, 1):
        pos, size = np.zeros(3), np.full(3, _WALLS)
        pos[axis], size[axis] = side * _WALLS, 0.01
        self._add(mujoco.mjtGeom.mjGEOM_BOX, size, pos, np.eye(3).ravel(), rgb)
        wall = self._scene.geoms[self._scene.ngeom - 1]
        wall.emission, wall.specular = 1.0, 0.0
        wall.rgba[:3] = rgb

  def _add(self, shape: int, size: Any, pos: Any, mat: Any, rgb: Any) -> None:
    geom = self._scene.geoms[self._scene.ngeom]
    rgba = np.append(rgb, 1.0).astype(np.float32)
    mujoco.mjv_initGeom(geom, shape, size, pos, mat, rgba)
    self._scene.ngeom += 1


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
