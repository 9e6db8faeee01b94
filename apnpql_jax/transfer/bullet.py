"""The bodies of a MuJoCo model in PyBullet: loaded, placed, and where they are."""

from __future__ import annotations

from collections.abc import Generator, Sequence
import contextlib
import ctypes
import importlib
import os
from pathlib import Path
import sys
import tempfile
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.errors import ConfigError
from apnpql_jax.transfer import urdf

VERSION = 1
"""Version of Bullet's worlds; it increases if bodies, contacts or servos change."""


def require(option: str) -> None:
  """Raises ``ConfigError`` if PyBullet, which an option needs, is not installed."""
  with _quiet():
    try:
      importlib.import_module("pybullet")
    except ImportError:
      raise ConfigError(
        f"{option} needs PyBullet: pip install 'apnpql-jax[transfer]'"
      ) from None


def connect() -> Any:
  """Returns a client of a PyBullet simulator of its own, without a window."""
  with _quiet():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    return BulletClient(connection_mode=pybullet.DIRECT)


@contextlib.contextmanager
def _quiet() -> Generator[None]:
  """Drops what PyBullet's C code prints; standard output may be JSON."""
  flush = ctypes.CDLL(None).fflush
  sys.stdout.flush()
  sys.stderr.flush()
  flush(None)
  kept, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
  for stream in (1, 2):
    os.dup2(nowhere, stream)
  try:
    yield
  finally:
    flush(None)
    for stream, copy in zip((1, 2), kept, strict=True):
      os.dup2(copy, stream)
      os.close(copy)
    os.close(nowhere)


class Bodies:
  """The bodies of a MuJoCo model in a simulator."""

  def __init__(self, client: Any, model: mujoco.MjModel):
    """Loads one URDF file per tree of bodies."""
    self.client, self.model = client, model
    self.place: dict[int, tuple[int, int]] = {}
    """By body: PyBullet's body and its link, -1 for the base."""
    self.joints: dict[int, int] = {}
    """Links of the robot by the joints that move them."""
    self._offsets: dict[int, tuple[Any, Any]] = {}  # Of centers of mass.
    with tempfile.TemporaryDirectory() as folder:
      for root in urdf.roots(model):
        path = Path(folder) / f"{root}.urdf"
        path.write_text(urdf.write(model, root))
        self._load(root, path)
    self.robot = next(self.place[int(model.jnt_bodyid[j])][0] for j in self.joints)

  def reset(self, qpos: Any, mocap_pos: Any, mocap_quat: Any) -> None:
    """Puts everything to a state of MuJoCo, at rest; positions are in m and rad."""
    model = self.model
    for joint, link in self.joints.items():
      angle = float(qpos[model.jnt_qposadr[joint]])
      self.client.resetJointState(self.robot, link, angle)
    for root in urdf.roots(model)[1:]:
      if (mocap := model.body_mocapid[root]) >= 0:
        self._put(root, mocap_pos[mocap], mocap_quat[mocap])
      elif urdf.is_free(model, root):
        first = model.jnt_qposadr[model.body_jntadr[root]]
        self._put(root, qpos[first : first + 3], qpos[first + 3 : first + 7])

  def state(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns MuJoCo's qpos f64[nq] and qvel f64[nv], in m, rad, m/s and rad/s."""
    model = self.model
    qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
    found = self.client.getJointStates(self.robot, list(self.joints.values()))
    for joint, (angle, rate, *_) in zip(self.joints, found, strict=True):
      qpos[model.jnt_qposadr[joint]] = angle
      qvel[model.jnt_dofadr[joint]] = rate
    for root in urdf.roots(model)[1:]:
      if not urdf.is_free(model, root):
        continue
      joint = model.body_jntadr[root]
      pos, quat = self._base(root)
      mat = _matrix(self.client, quat)
      # PyBullet's velocity is that of the center of mass, MuJoCo's that of the frame.
      linear, angular = map(np.array, self.client.getBaseVelocity(self.place[root][0]))
      linear = linear - np.cross(angular, mat @ model.body_ipos[root])
      at, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
      qpos[at : at + 7] = [*pos, *np.roll(quat, 1)]
      qvel[dof : dof + 6] = [*linear, *(mat.T @ angular)]
    return qpos, qvel

  def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns position f64[3], m, and rotation f64[3, 3] of a body of the model."""
    loaded, link = self.place[int(body)]
    if link < 0:
      pos, quat = self._base(int(body))
    else:
      state = self.client.getLinkState(loaded, link, computeForwardKinematics=True)
      pos, quat = state[4:6]
    return np.array(pos), _matrix(self.client, quat)

  def _base(self, root: int) -> tuple[Sequence[float], Sequence[float]]:
    """Returns position and quaternion, in PyBullet's order, of the root of a tree."""
    center = self.client.getBasePositionAndOrientation(self.place[root][0])
    back = self.client.invertTransform(*self._offsets[root])
    return self.client.multiplyTransforms(*center, *back)

  def _put(self, root: int, pos: Any, quat: Any) -> None:
    """Places a body without a joint; PyBullet asks for its center of mass."""
    loaded, quat = self.place[root][0], np.roll(np.asarray(quat, float), -1)
    where = self.client.multiplyTransforms(
      np.asarray(pos, float), quat, *self._offsets[root]
    )
    self.client.resetBasePositionAndOrientation(loaded, *where)
    self.client.resetBaseVelocity(loaded, [0, 0, 0], [0, 0, 0])

  def _load(self, root: int, path: Path) -> None:
    """Loads the file of a tree of bodies and finds its links and joints."""
    client, model = self.client, self.model
    loaded = client.loadURDF(
      str(path),
      basePosition=model.body_pos[root].tolist(),
      baseOrientation=np.roll(model.body_quat[root], -1).tolist(),
      useFixedBase=not urdf.is_free(model, root),
      flags=client.URDF_USE_INERTIA_FROM_FILE,
    )
    self.place[root] = loaded, -1
    self._offsets[root] = client.getDynamicsInfo(loaded, -1)[3:5]
    for link in range(client.getNumJoints(loaded)):
      info = client.getJointInfo(loaded, link)
      self.place[_number(info[12])] = loaded, link
      if info[2] == client.JOINT_REVOLUTE:
        self.joints[_number(info[1])] = link


def _number(name: bytes) -> int:
  """Returns the id of MuJoCo in a name that ``urdf.write`` gave."""
  return int(name.decode().rsplit("_", 1)[1])


def _matrix(client: Any, quat: Sequence[float]) -> np.ndarray:
  """Returns the rotation of a quaternion in PyBullet's order, f64[3, 3]."""
  return np.reshape(client.getMatrixFromQuaternion(quat), (3, 3))
