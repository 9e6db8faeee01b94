"""The contract of an exported policy: what the code around it must provide and obey.

Everything is read from the compiled scene and the settings of the run, as plain values
for JSON. Poses are a position in m and a quaternion wxyz. The world has its origin at
the robot's base, z up, and the workspace along +x.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any

import jax
import mujoco
import numpy as np

from apnpql_jax.agents.networks import Params
from apnpql_jax.config import codec
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.runs import leaves
from apnpql_jax.sim import motors
from apnpql_jax.sim.names import (
  ARM_JOINTS,
  BASE_SITE,
  FLANGE_SITE,
  GRIPPER_JOINT,
  TOOL_SITE,
)
from apnpql_jax.sim.scene import Scene, fixed_bodies
from apnpql_jax.types import ACTION_DIM, Array

Json = dict[str, Any]

STATE_NAMES = (*ARM_JOINTS, GRIPPER_JOINT)
MEANINGS = {
  "robot": "last 3 robot states, oldest first, each in the order of joints.state; an "
  "episode of fewer instants repeats its first",
  "tool": "position of the tool in the world by forward kinematics of the arm, m",
  "global_image": "RGB, rows from the top; see cameras.global",
  "wrist_image": "RGB, rows from the top; see cameras.wrist",
  "objects": "points on the objects in the world, m; no sensor gives them",
  "primitives": "the true primitives, as actions; no sensor gives them",
}


def describe(
  config: EnvConfig, scene: Scene, shapes: dict[str, Any], *, lstm_instants: int
) -> Json:
  """Returns the parts of the contract that come from the scene and the settings.

  Args:
    config: The environment of the run.
    scene: The scene of its task.
    shapes: ShapeDtypeStructs of an observation with a batch axis of 1, by field.
    lstm_instants: L of ``EnvState.recent``; 0 without an LSTM.
  """
  model = scene.model
  data = mujoco.MjData(model)
  data.qpos[:] = scene.keyframe("neutral")
  mujoco.mj_forward(model, data)
  return {
    "task": config.task,
    "control_period_s": config.control_period_s,
    "time_limit_s": config.time_limit_s,
    "observation": _observation(shapes, lstm_instants),
    "action": _action(model, scene),
    "joints": _joints(model, scene),
    "frames": _frames(data, scene),
    "cameras": {
      name: _camera(data, scene, name, getattr(config, f"{name}_size"))
      for name in ("global", "wrist")
      if f"{name}_image" in shapes
    },
    "randomization": dict(codec.flatten(config.randomization))
    if config.randomize
    else None,
  }


def hash_of(params: Params) -> str:
  """Returns a SHA-256 of parameters: names, kinds and bytes, sorted by name."""
  digest = hashlib.sha256()
  for name, leaf in sorted(leaves.named(jax.device_get(params)).items()):
    digest.update(f"{name} {leaves.kind(leaf)}\n".encode())
    digest.update(np.ascontiguousarray(leaf).tobytes())
  return digest.hexdigest()


def _observation(shapes: dict[str, Any], lstm_instants: int) -> Json:
  fields = {
    name: {
      "shape": list(x.shape[1:]),
      "dtype": str(x.dtype),
      "meaning": MEANINGS[name],
    }
    for name, x in shapes.items()
  }
  about: Json = {"batch": 1, "fields": fields}
  if lstm_instants:
    about["instants"] = {
      "count": lstm_instants,
      "meaning": "first axis of every field: the last observations, oldest first; an "
      "episode of fewer instants repeats its first",
    }
  return about


def _action(model: mujoco.MjModel, scene: Scene) -> Json:
  torques = model.actuator_ctrlrange[: len(ARM_JOINTS), 1]
  return {
    "shape": [ACTION_DIM],
    "dtype": "float32",
    "order": [*ARM_JOINTS, "gripper"],
    "meaning": "desired joint velocities, then 1 to close the gripper or 0 to open it; "
    "held for one control period",
    "units": ["rad/s"] * len(ARM_JOINTS) + ["1"],
    "low": [-motors.MAX_VELOCITY] * len(ARM_JOINTS) + [0.0],
    "high": [motors.MAX_VELOCITY] * len(ARM_JOINTS) + [1.0],
    "motor_model": {
      "meaning": "joint acceleration = clip(gain (desired - present velocity))",
      "gain_1_per_s": motors.VELOCITY_GAIN,
      "acceleration_limit_rad_per_s2": motors.MAX_ACCELERATION,
      "torque_limit_nm": torques.tolist(),
    },
  }


def _joints(model: mujoco.MjModel, scene: Scene) -> Json:
  ranges = [model.joint(name).range.tolist() for name in STATE_NAMES]
  return {
    "state": list(STATE_NAMES),
    "units": "rad",
    "ranges": ranges,
    "neutral": [
      *scene.keyframe("neutral")[scene.arm_qpos].tolist(),
      float(scene.keyframe("neutral")[scene.gripper_qpos]),
    ],
    "gripper": {
      "open_rad": ranges[-1][0],
      "closed_rad": ranges[-1][1],
      "pad_gap_m": "2 (0.0041 + 0.057 cos(q + pi / 6)), q in rad",
      "pad_gap_speed_m_per_s": motors.GRIPPER_SPEED,
    },
  }


def _frames(data: mujoco.MjData, scene: Scene) -> Json:
  base, flange, tool = (
    _pose(data.site(name).xpos, data.site(name).xmat)
    for name in (BASE_SITE, FLANGE_SITE, TOOL_SITE)
  )
  return {
    "base_in_world": _shown(base),
    "tool_in_flange": _shown(_relative(flange, tool)),
    "meaning": "base is the frame of the arm's controller, flange its tool flange; the "
    "tool is between the closed finger tips, z forward, y the closing direction",
  }


def _camera(
  data: mujoco.MjData, scene: Scene, name: str, size: tuple[int, int]
) -> Json:
  """Returns image and pose of a camera; axes: x right, y down, z forward (OpenCV)."""
  index, (height, width) = scene.id("camera", name), size
  fovy = float(scene.model.cam_fovy[index])
  focal = 0.5 * height / math.tan(math.radians(fovy) / 2)
  optical = data.cam_xmat[index].reshape(3, 3) * np.array([1.0, -1.0, -1.0])
  camera = data.cam_xpos[index], optical
  site = data.site(FLANGE_SITE)
  fixed = fixed_bodies(scene.model)[scene.model.cam_bodyid[index]]
  where = camera if fixed else _relative(_pose(site.xpos, site.xmat), camera)
  return {
    "height": height,
    "width": width,
    "vertical_fov_deg": fovy,
    "horizontal_fov_deg": math.degrees(2 * math.atan(0.5 * width / focal)),
    "intrinsics_px": {
      "fx": focal,
      "fy": focal,
      "cx": 0.5 * (width - 1),
      "cy": 0.5 * (height - 1),
    },
    "pose_in_world" if fixed else "pose_in_flange": _shown(where),
    "preparation": "undistort, crop around the optical axis to this field of view, "
    "resize by area",
  }


_Pose = tuple[Array | np.ndarray, Array | np.ndarray]


def _pose(pos: np.ndarray, mat: np.ndarray) -> _Pose:
  return pos.copy(), mat.reshape(3, 3).copy()


def _relative(frame: _Pose, pose: _Pose) -> _Pose:
  """Returns a pose in the coordinates of another frame."""
  inverse = np.asarray(frame[1]).T
  return inverse @ (np.asarray(pose[0]) - frame[0]), inverse @ pose[1]


def _shown(pose: _Pose) -> Json:
  quat = np.zeros(4)
  mujoco.mju_mat2Quat(quat, np.asarray(pose[1], np.float64).reshape(9))
  pos, quat = (np.asarray(x, np.float64).round(9) + 0.0 for x in (pose[0], quat))
  return {"position_m": pos.tolist(), "quaternion_wxyz": quat.tolist()}
