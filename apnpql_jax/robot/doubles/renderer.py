"""The process that draws what the doubles' cameras see, with OpenGL off screen."""

from __future__ import annotations

from multiprocessing.connection import Connection

import mujoco
import numpy as np

from apnpql_jax.robot.doubles.plant import compile_scene
from apnpql_jax.sim.graphics import View

AMBIENT, DIFFUSE = 0.35, 0.65
"""Light of the images of the training."""


class Renderer:
  """Renderer of a scene from its own cameras, with other fields of view."""

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
    self._cameras = list(fields_of_view)
    for name, angle in fields_of_view.items():
      model.camera(name).fovy = angle
    model.vis.quality.offsamples = 0  # Which is twice as fast.
    model.vis.quality.shadowsize = 0
    model.vis.headlight.diffuse[:] = model.vis.headlight.specular[:] = 0
    model.vis.headlight.ambient[:], model.light_diffuse[:] = AMBIENT, DIFFUSE
    model.light_ambient[:] = model.light_specular[:] = 0
    self.view = View(model, *size, shadows=False, reflections=False)

  def draw(self, state: dict[str, list]) -> list[np.ndarray]:
    """Returns the images u8[H, W, 3] of a state, see ``server.Remote.state``."""
    data = self._data
    for name in ("qpos", "mocap_pos", "mocap_quat"):
      getattr(data, name)[...] = np.reshape(state[name], getattr(data, name).shape)
    mujoco.mj_forward(self._model, data)
    return [self.view.draw(data, name) for name in self._cameras]


def main(pipe: Connection) -> None:
  """Draws one state after the other, until the parent ends."""
  renderer = Renderer(*pipe.recv())
  with renderer.view:
    pipe.send(None)
    while True:
      pipe.send(renderer.draw(pipe.recv()))
