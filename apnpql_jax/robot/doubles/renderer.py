"""The process that draws what the doubles' cameras see, with OpenGL off screen."""

from __future__ import annotations

from multiprocessing.connection import Connection

import mujoco
import numpy as np

from apnpql_jax.robot.doubles.plant import compile_scene
from apnpql_jax.sim.graphics import off_screen

AMBIENT, DIFFUSE = 0.35, 0.65
"""Light of the images of the training."""


class Renderer:
  """Draws a scene from its own cameras with other fields of view."""

  def __init__(self, scene: str, fields_of_view: dict[str, float], size: list[int]):
    """Compiles the scene.

    Args:
      scene: Name of the task, or path of its MJCF file.
      fields_of_view: Camera of the scene -> vertical field of view, degrees.
      size: Height and width of the images.

    Raises:
      ConfigError: No graphics library can be loaded.
    """
    self._model = model = compile_scene(scene)
    self._data = mujoco.MjData(model)
    self._cameras = [model.camera(name).id for name in fields_of_view]
    model.cam_fovy[self._cameras] = list(fields_of_view.values())
    height, width = size
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    model.vis.quality.offsamples = 0  # Which is twice as fast.
    model.vis.quality.shadowsize = 0
    model.vis.headlight.diffuse[:] = model.vis.headlight.specular[:] = 0
    model.vis.headlight.ambient[:], model.light_diffuse[:] = AMBIENT, DIFFUSE
    model.light_ambient[:] = model.light_specular[:] = 0
    self._view = mujoco.MjrRect(0, 0, width, height)
    self._gl = off_screen(width, height)
    self._scene = mujoco.MjvScene(model, model.ngeom + 64)
    self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    self._option = mujoco.MjvOption()
    self._option.sitegroup[:] = 0
    self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

  def draw(self, state: dict[str, list]) -> list[np.ndarray]:
    """Returns the images u8[H, W, 3] of a state, see ``server.Remote.state``."""
    data = self._data
    for name in ("qpos", "mocap_pos", "mocap_quat"):
      getattr(data, name)[...] = np.reshape(state[name], getattr(data, name).shape)
    mujoco.mj_forward(self._model, data)
    images = []
    for index in self._cameras:
      camera = mujoco.MjvCamera()
      camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, index
      mujoco.mjv_updateScene(
        self._model,
        data,
        self._option,
        None,
        camera,
        mujoco.mjtCatBit.mjCAT_ALL,
        self._scene,
      )
      pixels = np.zeros((self._view.height, self._view.width, 3), np.uint8)
      mujoco.mjr_render(self._view, self._scene, self._context)
      mujoco.mjr_readPixels(pixels, None, self._view, self._context)
      images.append(pixels[::-1])
    return images

  def close(self) -> None:
    """Frees the graphics."""
    self._context.free()
    self._gl.free()


def main(pipe: Connection) -> None:
  """Draws one state after the other, until the parent ends."""
  renderer = Renderer(*pipe.recv())
  try:
    pipe.send(None)
    while True:
      pipe.send(renderer.draw(pipe.recv()))
  finally:
    renderer.close()
