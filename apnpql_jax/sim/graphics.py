"""Off-screen graphics and the resizing of images; no JAX."""

from __future__ import annotations

from collections.abc import Callable
import importlib
import os
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.errors import ConfigError, one_line


def area_resized(image: np.ndarray, factor: int) -> np.ndarray:
  """Returns the means of blocks of factor x factor pixels, u8[H, W, 3]."""
  height, width = image.shape[0] // factor, image.shape[1] // factor
  blocks = image.reshape(height, factor, width, factor, 3).astype(np.float32)
  return (blocks.mean((1, 3)) + 0.5).astype(np.uint8)


def off_screen(width: int, height: int) -> Any:
  """Returns a current OpenGL context without a window.

  Raises:
    ConfigError: No graphics library can be loaded.
  """
  chosen = os.environ.get("MUJOCO_GL", "")
  reasons = []
  for library in [chosen] if chosen in ("egl", "osmesa") else ["egl", "osmesa"]:
    try:
      context = importlib.import_module(f"mujoco.{library}").GLContext(width, height)
      context.make_current()
      return context
    except Exception as error:  # Whatever a missing library causes.
      reasons.append(f"{library}: {one_line(error)}")
  raise ConfigError(
    "OpenGL needs EGL or OSMesa (Debian: libegl1 with libegl-mesa0, or "
    f"libosmesa6); {'; '.join(reasons)}"
  )


class View:
  """MuJoCo's renderer off screen; belongs to the thread that made it.

  Raises:
    ConfigError: No graphics library can be loaded.
  """

  def __init__(
    self,
    model: mujoco.MjModel,
    height: int,
    width: int,
    *,
    shadows: bool = True,
    reflections: bool = True,
  ):
    """Prepares images of up to a size; sets the model's size of off-screen buffers."""
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    self._model, self._size = model, (height, width)
    self._gl = off_screen(width, height)
    self._scene = mujoco.MjvScene(model, model.ngeom + 64)
    self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
    self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = reflections
    self._option = mujoco.MjvOption()
    self._option.sitegroup[:] = 0
    self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

  def __enter__(self) -> View:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the graphics, which the end of Python would do too late."""
    self._gl.make_current()
    self._context.free()
    self._gl.free()

  def draw(self, data: mujoco.MjData, camera: str) -> np.ndarray:
    """Returns the image u8[H, W, 3] of a camera of the model."""
    return self.render(data, self._model.camera(camera).id, self._size)[0]

  def render(
    self,
    data: mujoco.MjData,
    camera: int,
    size: tuple[int, int],
    add: Callable[[mujoco.MjvScene], None] | None = None,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Renders a camera of the model in a size of its own.

    Args:
      data: The state.
      camera: Number of the camera.
      size: Height and width, at most those of the view.
      add: Adds geoms that are not in the model.

    Returns:
      The image u8[H, W, 3], and the depth f32[H, W], 1 where there is nothing.
    """
    self._gl.make_current()
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.fixedcamid = camera
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(
      self._model, data, self._option, None, view, everything, self._scene
    )
    if add is not None:
      add(self._scene)
    where = mujoco.MjrRect(0, 0, size[1], size[0])
    pixels, depth = np.zeros((*size, 3), np.uint8), np.zeros(size, np.float32)
    mujoco.mjr_render(where, self._scene, self._context)
    mujoco.mjr_readPixels(pixels, depth, where, self._context)
    return pixels[::-1], depth[::-1]
