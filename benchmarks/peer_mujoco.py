"""C MuJoCo in the manner of Gymnasium: one world and its renderers per process.

A side of peers.py, of the same scene, time step, control law and images as this
project's native engine. With "gymnasium" in the settings the worlds are those of
Gymnasium's AsyncVectorEnv, which steps all and waits for the last; without, processes
that run freely. Shadows and multisampling of the renderer are off, which makes its
images ten times cheaper.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import json
import os
from pathlib import Path
import sys
import tempfile
from typing import Any

import mujoco
import numpy as np
from peer_worlds import (
  CONTROL_PERIOD_S,
  EPISODE_STEPS,
  RESETS,
  Processes,
  World,
  export,
  load,
)
import sides

VELOCITY_GAIN, MAX_ACCELERATION = 25.0, 1.2
GRIPPER_SPEED, GRIPPER_GAIN, FINGER_LENGTH, FINGER_ANGLE = 0.075, 10.0, 0.057, np.pi / 6
"""The control law of ``sim.physics``, which would import JAX."""


class MujocoEnv:
  """See ``peer_worlds.Env``."""

  def __init__(self, world: World):
    self.world, model = world, world.model
    self.data = mujoco.MjData(model)
    self._qpos = model.jnt_qposadr[world.motors]
    self._dof = model.jnt_dofadr[world.motors]
    self._limit = model.actuator_ctrlrange[:, 1]
    self._wanted, self._force = np.zeros(model.nv), np.zeros(model.nv)
    self._substeps = round(CONTROL_PERIOD_S / model.opt.timestep)
    self._renderers: dict[str, mujoco.Renderer] = {}
    model.vis.quality.offsamples = model.vis.quality.shadowsize = 0

  def reset(self, row: int) -> None:
    """See ``peer_worlds.Env``."""
    mujoco.mj_resetData(self.world.model, self.data)
    self.data.qpos[:] = self.world.qpos[row]
    self.data.mocap_pos[:] = self.world.mocap_pos[row]
    self.data.mocap_quat[:] = self.world.mocap_quat[row]

  def step(self, action: np.ndarray, *, images: bool) -> dict[str, Any]:
    """See ``peer_worlds.Env``."""
    model, data = self.world.model, self.data
    for _ in range(self._substeps):
      mujoco.mj_step1(model, data)
      data.ctrl[:] = self._control(action)
      mujoco.mj_step2(model, data)
    seen: dict[str, Any] = {"robot": data.qpos[self._qpos].astype(np.float32)}
    if images:
      mujoco.mj_kinematics(model, data)
      mujoco.mj_camlight(model, data)
      seen |= {name: self.image(name) for name in self.world.cameras}
    return seen

  def image(self, name: str) -> np.ndarray:
    """u8[H, W, 3]."""
    if name not in self._renderers:
      size = self.world.cameras[name]
      self._renderers[name] = mujoco.Renderer(self.world.model, *size)
    self._renderers[name].update_scene(self.data, name)
    return self._renderers[name].render()

  def _control(self, action: np.ndarray) -> np.ndarray:
    """f64[7]: inverse dynamics of the arm, a bounded servo of the gripper."""
    data, arm, finger = self.data, self._dof[:6], self._dof[6]
    acceleration = VELOCITY_GAIN * (action[:6] - data.qvel[arm])
    self._wanted[arm] = acceleration.clip(-MAX_ACCELERATION, MAX_ACCELERATION)
    mujoco.mj_mulM(self.world.model, data, self._force, self._wanted)
    angle = data.qpos[self._qpos[6]].clip(0.0, 1.1)
    slope = 2 * FINGER_LENGTH * np.sin(angle + FINGER_ANGLE)
    speed = (2 * action[6] - 1) * GRIPPER_SPEED / slope
    torque = np.append(
      self._force[arm] + data.qfrc_bias[arm], GRIPPER_GAIN * (speed - data.qvel[finger])
    )
    return torque.clip(-self._limit, self._limit)


def make(folder: Path) -> MujocoEnv:
  """The world of a process."""
  return MujocoEnv(load(folder))


def gymnasium_measure(
  folder: Path, count: int, *, images: bool
) -> Callable[[float], float]:
  """Control steps per second of AsyncVectorEnv, started at the first call."""
  from gymnasium.vector import AsyncVectorEnv

  @functools.cache
  def envs() -> AsyncVectorEnv:
    # Spawned, because a graphics library does not survive a fork.
    build = functools.partial(gymnasium_env, folder, images=images)
    vector = AsyncVectorEnv([build] * count, context="spawn")
    vector.reset(seed=0)
    return vector

  def measure(seconds: float) -> float:
    vector = envs()
    return sides.rate_of(lambda: vector.step(vector.action_space.sample()), count)(
      seconds
    )

  return measure


def gymnasium_env(folder: Path, *, images: bool) -> Any:
  """The world with the spaces that Gymnasium asks for."""
  import gymnasium
  from gymnasium import spaces

  class Table(gymnasium.Env):
    def __init__(self):
      self._env = make(folder)
      seen: dict[str, spaces.Space] = {"robot": spaces.Box(-7.0, 7.0, (7,))}
      for name, size in self._env.world.cameras.items() if images else ():
        seen[name] = spaces.Box(0, 255, (*size, 3), np.uint8)
      self.observation_space = spaces.Dict(seen)
      self.action_space = spaces.Box(-1.0, 1.0, (7,))

    def reset(self, *, seed=None, options=None):
      super().reset(seed=seed)
      self._env.reset(int(self.np_random.integers(RESETS)))
      self._steps = 0
      return self._env.step(np.zeros(7), images=images), {}

    def step(self, action):
      self._steps += 1
      command = np.append(action[:6], float(action[6] > 0))
      seen = self._env.step(command, images=images)
      return seen, 0.0, False, self._steps >= EPISODE_STEPS, {}

  return Table()


def main(settings: dict[str, Any]) -> None:
  """Serves steps with images and without."""
  about: dict[str, Any] = {"graphics": os.environ.get("MUJOCO_GL", "")}
  with tempfile.TemporaryDirectory() as name:
    folder, count = Path(name), settings["processes"]
    export(settings["task"], folder)
    if settings["gymnasium"]:
      import gymnasium

      about["gymnasium"] = gymnasium.__version__
      measure = functools.partial(gymnasium_measure, folder, count)
    else:
      measure = Processes(make, folder, count).measure
    sides.serve(
      {"cameras": measure(images=True), "physics": measure(images=False)}, **about
    )


if __name__ == "__main__":
  main(json.loads(sys.argv[1]))
