"""The paper's set-up: PyBullet with TinyRenderer, one world per process.

A side of compare.py. The scene is loaded from URDF files with the inertias of the file
and stepped at PyBullet's 1/240 s. Its joints have velocity motors without a limit on
acceleration, its fingers no linkage, and its contacts default parameters. Images come
without the segmentation, which the learner does not need.
"""

from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from apnpql_jax.transfer.bullet import Bodies
from benchmarks.peers import sides, worlds

SUBSTEPS = round(240 * worlds.CONTROL_PERIOD_S)
FINGER_SPEED = 0.8  # rad/s; the pads close at about 75 mm/s.


class BulletEnv:
  """A ``worlds.Env`` in PyBullet."""

  def __init__(self, world: worlds.World):
    """Loads the scene of a world into a simulator of its own."""
    self.world = world
    self.bullet = BulletClient(connection_mode=pybullet.DIRECT)
    self.bullet.setGravity(0, 0, -9.81)
    self._bodies = Bodies(self.bullet, world.model)
    self.pose, joints = self._bodies.pose, self._bodies.joints
    arm, finger = world.motors[:6].tolist(), int(world.motors[6])
    self._arm = [joints[joint] for joint in arm]
    self._fingers = [link for joint, link in joints.items() if joint >= finger]
    self._robot = self._bodies.robot
    self._forces = world.model.actuator_ctrlrange[:, 1].tolist()

  def reset(self, row: int) -> None:
    """See ``worlds.Env``."""
    world = self.world
    self._bodies.reset(world.qpos[row], world.mocap_pos[row], world.mocap_quat[row])

  def step(self, action: np.ndarray, *, images: bool) -> dict[str, Any]:
    """See ``worlds.Env``."""
    speed, count = (2 * action[6] - 1) * FINGER_SPEED, len(self._fingers)
    self.bullet.setJointMotorControlArray(
      self._robot,
      [*self._arm, *self._fingers],
      controlMode=pybullet.VELOCITY_CONTROL,
      targetVelocities=[*action[:6].tolist(), *([speed] * count)],
      forces=self._forces[:6] + self._forces[6:] * count,
    )
    for _ in range(SUBSTEPS):
      self.bullet.stepSimulation()
    joints = self.bullet.getJointStates(self._robot, [*self._arm, self._fingers[0]])
    seen: dict[str, Any] = {"robot": np.array([joint[0] for joint in joints])}
    return seen | self.look() if images else seen

  def look(self) -> dict[str, np.ndarray]:
    """See ``worlds.Env``."""
    return {name: self._image(name) for name in self.world.cameras}

  def _image(self, name: str) -> np.ndarray:
    model, (height, width) = self.world.model, self.world.cameras[name]
    camera = model.camera(name).id
    pos, mat = self.pose(model.cam_bodyid[camera])
    eye = pos + mat @ model.cam_pos[camera]
    turn = self.bullet.getMatrixFromQuaternion(np.roll(model.cam_quat[camera], -1))
    axes = mat @ np.reshape(turn, (3, 3))
    lens = (model.cam_fovy[camera], width / height, 0.01, 5.0)
    matrices = (
      self.bullet.computeViewMatrix(eye, eye - axes[:, 2], axes[:, 1]),
      self.bullet.computeProjectionMatrixFOV(*lens),
    )
    kind = {"renderer": pybullet.ER_TINY_RENDERER}
    kind["flags"] = pybullet.ER_NO_SEGMENTATION_MASK
    picture = self.bullet.getCameraImage(width, height, *matrices, **kind)[2]
    return np.reshape(picture, (height, width, 4))[..., :3].astype(np.uint8)


def build(settings: sides.Settings) -> sides.Built:
  """Builds one world."""
  env = BulletEnv(worlds.load(settings["folder"]))
  about = {"api_version": pybullet.getAPIVersion()}
  return worlds.measures(env, settings["seed"]), about
