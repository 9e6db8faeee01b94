"""C MuJoCo in the manner of Gymnasium: one world and its renderers per process.

A side of compare.py with the scene, time step, control law and images of this project's
native engine. With "gymnasium" in the settings, Gymnasium's AsyncVectorEnv steps all
worlds and waits for the slowest; otherwise processes run freely. The renderer draws
without shadows and multisampling, which makes its images ten times cheaper.
"""

import functools
import os
from typing import Any

import mujoco
import numpy as np

from benchmarks.peers import sides, worlds

VELOCITY_GAIN, MAX_ACCELERATION = 25.0, 1.2
GRIPPER_SPEED, GRIPPER_GAIN, FINGER_LENGTH, FINGER_ANGLE = 0.075, 10.0, 0.057, np.pi / 6
"""The control law of ``sim.physics``, which would import JAX."""


class MujocoEnv:
  """A ``worlds.Env`` in C MuJoCo."""

  def __init__(self, world: worlds.World):
    """Builds the world; renderers are built at the first image."""
    self.world, model = world, world.model
    self.data = mujoco.MjData(model)
    self._qpos = model.jnt_qposadr[world.motors]
    self._dof = model.jnt_dofadr[world.motors]
    self._limit = model.actuator_ctrlrange[:, 1]
    self._wanted, self._force = np.zeros(model.nv), np.zeros(model.nv)
    self._substeps = round(worlds.CONTROL_PERIOD_S / model.opt.timestep)
    self._renderers: dict[str, mujoco.Renderer] = {}
    model.vis.quality.offsamples = model.vis.quality.shadowsize = 0

  def reset(self, row: int) -> None:
    """See ``worlds.Env``."""
    mujoco.mj_resetData(self.world.model, self.data)
    self.data.qpos[:] = self.world.qpos[row]
    self.data.mocap_pos[:] = self.world.mocap_pos[row]
    self.data.mocap_quat[:] = self.world.mocap_quat[row]

  def step(self, action: np.ndarray, *, images: bool) -> dict[str, Any]:
    """See ``worlds.Env``."""
    model, data = self.world.model, self.data
    for _ in range(self._substeps):
      mujoco.mj_step1(model, data)
      data.ctrl[:] = self._control(action)
      mujoco.mj_step2(model, data)
    seen: dict[str, Any] = {"robot": data.qpos[self._qpos].astype(np.float32)}
    return seen | self.look() if images else seen

  def look(self) -> dict[str, np.ndarray]:
    """See ``worlds.Env``."""
    mujoco.mj_kinematics(self.world.model, self.data)
    mujoco.mj_camlight(self.world.model, self.data)
    return {name: self._image(name) for name in self.world.cameras}

  def _image(self, name: str) -> np.ndarray:
    if name not in self._renderers:
      size = self.world.cameras[name]
      self._renderers[name] = mujoco.Renderer(self.world.model, *size)
    self._renderers[name].update_scene(self.data, name)
    return self._renderers[name].render()

  def _control(self, action: np.ndarray) -> np.ndarray:
    """Returns f64[7]: inverse dynamics of the arm, a bounded servo of the gripper."""
    data, arm, finger = self.data, self._dof[:6], self._dof[6]
    acceleration = VELOCITY_GAIN * (action[:6] - data.qvel[arm])
    self._wanted[arm] = acceleration.clip(-MAX_ACCELERATION, MAX_ACCELERATION)
    mujoco.mj_mulM(self.world.model, data, self._force, self._wanted)
    angle = data.qpos[self._qpos[6]].clip(0.0, 1.1)
    slope = 2 * FINGER_LENGTH * np.sin(angle + FINGER_ANGLE)
    speed = (2 * action[6] - 1) * GRIPPER_SPEED / slope
    close = GRIPPER_GAIN * (speed - data.qvel[finger])
    torque = np.append(self._force[arm] + data.qfrc_bias[arm], close)
    return torque.clip(-self._limit, self._limit)


def build(settings: sides.Settings) -> sides.Built:
  """Builds one world, or all those of AsyncVectorEnv."""
  about = {"graphics": os.environ.get("MUJOCO_GL", "")}
  if not settings["gymnasium"]:
    env = MujocoEnv(worlds.load(settings["folder"]))
    return worlds.measures(env, settings["seed"]), about
  import gymnasium

  cameras = gymnasium_measure(settings, images=True)
  physics = gymnasium_measure(settings, images=False)
  about |= {"gymnasium": gymnasium.__version__}
  return {"cameras": cameras, "physics": physics}, about


def gymnasium_measure(settings: sides.Settings, *, images: bool) -> sides.Measure:
  """Returns a measure of AsyncVectorEnv, which starts at the first request."""
  from gymnasium.vector import AsyncVectorEnv

  count = settings["processes"]

  @functools.cache
  def vector() -> AsyncVectorEnv:
    # Spawned, because a graphics library does not survive a fork.
    make = functools.partial(gymnasium_env, settings["folder"], images=images)
    envs = AsyncVectorEnv([make] * count, context="spawn")
    envs.reset(seed=0)
    return envs

  return sides.rate_of(lambda: vector().step(vector().action_space.sample()), count)


def gymnasium_env(folder: str, *, images: bool) -> Any:
  """Builds the world with the spaces that Gymnasium asks for."""
  import gymnasium
  from gymnasium import spaces

  class Table(gymnasium.Env):
    def __init__(self):
      self._env = MujocoEnv(worlds.load(folder))
      seen: dict[str, spaces.Space] = {"robot": spaces.Box(-7.0, 7.0, (7,))}
      for name, size in self._env.world.cameras.items() if images else ():
        seen[name] = spaces.Box(0, 255, (*size, 3), np.uint8)
      self.observation_space = spaces.Dict(seen)
      self.action_space = spaces.Box(-1.0, 1.0, (7,))

    def reset(self, *, seed=None, options=None):
      super().reset(seed=seed)
      self._env.reset(int(self.np_random.integers(worlds.RESETS)))
      self._steps = 0
      return self._env.step(np.zeros(7), images=images), {}

    def step(self, action):
      self._steps += 1
      command = np.append(action[:6], float(action[6] > 0))
      seen = self._env.step(command, images=images)
      return seen, 0.0, False, self._steps >= worlds.EPISODE_STEPS, {}

  return Table()
