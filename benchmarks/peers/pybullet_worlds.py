"""The paper's set-up: PyBullet with TinyRenderer, one world per process.

A side of compare.py. The scene is loaded from URDF files with the inertias of the file
and stepped at PyBullet's 1/240 s. Its joints have velocity motors without a limit on
acceleration, its fingers no linkage, and its contacts default parameters. Images come
without the segmentation, which the learner does not need.
"""

from collections.abc import Sequence
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from benchmarks.peers import sides, urdf, worlds

SUBSTEPS = round(240 * worlds.CONTROL_PERIOD_S)
FINGER_SPEED = 0.8  # rad/s; the pads close at about 75 mm/s.


class BulletEnv:
  """See ``worlds.Env``."""

  def __init__(self, world: worlds.World):
    """Loads the scene of a world into a simulator of its own."""
    self.world = world
    self.bullet = BulletClient(connection_mode=pybullet.DIRECT)
    self.bullet.setGravity(0, 0, -9.81)
    self._place: dict[int, tuple[int, int]] = {}  # Body -> PyBullet's body, its link.
    self._joints: dict[int, int] = {}  # Joint of the arm or a finger -> link.
    with tempfile.TemporaryDirectory() as folder:
      for root in urdf.roots(world.model):
        path = Path(folder) / f"{root}.urdf"
        path.write_text(urdf.write(world.model, root))
        self._load(root, path)
    arm, finger = world.motors[:6].tolist(), int(world.motors[6])
    self._arm = [self._joints[joint] for joint in arm]
    self._fingers = [link for j, link in self._joints.items() if j >= finger]
    self._robot = self._place[int(world.model.jnt_bodyid[arm[0]])][0]
    self._forces = world.model.actuator_ctrlrange[:, 1].tolist()

  def reset(self, row: int) -> None:
    """See ``worlds.Env``."""
    model, qpos = self.world.model, self.world.qpos[row]
    for joint, link in self._joints.items():
      self.bullet.resetJointState(self._robot, link, qpos[model.jnt_qposadr[joint]])
    for root in urdf.roots(model)[1:]:
      if (mocap := model.body_mocapid[root]) >= 0:
        poses = (self.world.mocap_pos, self.world.mocap_quat)
        self._put(root, *(pose[row, mocap] for pose in poses))
      elif urdf.is_free(model, root):
        first = model.jnt_qposadr[model.body_jntadr[root]]
        self._put(root, qpos[first : first + 3], qpos[first + 3 : first + 7])

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
    axes = mat @ _matrix(np.roll(model.cam_quat[camera], -1))
    lens = (model.cam_fovy[camera], width / height, 0.01, 5.0)
    matrices = (
      self.bullet.computeViewMatrix(eye, eye - axes[:, 2], axes[:, 1]),
      self.bullet.computeProjectionMatrixFOV(*lens),
    )
    kind = {"renderer": pybullet.ER_TINY_RENDERER}
    kind["flags"] = pybullet.ER_NO_SEGMENTATION_MASK
    picture = self.bullet.getCameraImage(width, height, *matrices, **kind)[2]
    return np.reshape(picture, (height, width, 4))[..., :3].astype(np.uint8)

  def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns position f64[3] and rotation f64[3, 3] of a body of MuJoCo's model."""
    bullet_body, link = self._place[int(body)]
    if link < 0:
      center = self.bullet.getBasePositionAndOrientation(bullet_body)
      offset = self.bullet.getDynamicsInfo(bullet_body, -1)[3:5]
      back = self.bullet.invertTransform(*offset)
      pos, quat = self.bullet.multiplyTransforms(*center, *back)
    else:
      state = self.bullet.getLinkState(bullet_body, link, computeForwardKinematics=True)
      pos, quat = state[4:6]
    return np.array(pos), _matrix(quat)

  def _load(self, root: int, path: Path) -> None:
    model = self.world.model
    loaded = self.bullet.loadURDF(
      str(path),
      basePosition=model.body_pos[root].tolist(),
      baseOrientation=np.roll(model.body_quat[root], -1).tolist(),
      useFixedBase=not urdf.is_free(model, root),
      flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
    )
    self._place[root] = loaded, -1
    for link in range(self.bullet.getNumJoints(loaded)):
      info = self.bullet.getJointInfo(loaded, link)
      self._place[_number(info[12])] = loaded, link
      if info[2] == pybullet.JOINT_REVOLUTE:
        self._joints[_number(info[1])] = link

  def _put(self, root: int, pos: np.ndarray, quat: np.ndarray) -> None:
    """Places a body without a joint; PyBullet asks for its center of mass."""
    loaded = self._place[root][0]
    offset = self.bullet.getDynamicsInfo(loaded, -1)[3:5]
    where = self.bullet.multiplyTransforms(pos, np.roll(quat, -1), *offset)
    self.bullet.resetBasePositionAndOrientation(loaded, *where)
    self.bullet.resetBaseVelocity(loaded, [0, 0, 0], [0, 0, 0])


def build(settings: sides.Settings) -> sides.Built:
  """Builds one world."""
  env = BulletEnv(worlds.load(settings["folder"]))
  about = {"api_version": pybullet.getAPIVersion()}
  return worlds.measures(env, settings["seed"]), about


def _number(name: bytes) -> int:
  return int(name.decode().rsplit("_", 1)[1])


def _matrix(quat: Sequence[float]) -> np.ndarray:
  """Returns the rotation of a quaternion in PyBullet's order, f64[3, 3]."""
  return np.reshape(pybullet.getMatrixFromQuaternion(quat), (3, 3))
