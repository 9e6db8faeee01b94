"""Limits on how far a camera may be from where the policy was trained for."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from apnpql_jax.config.ranges import WRIST_SHARE
from apnpql_jax.errors import ConfigError, DeviceError
from apnpql_jax.robot import images
from apnpql_jax.robot.calibration.lenses import Lens

Json = dict[str, Any]

TOLERANCE_M = {"global": 0.005, "wrist": 0.002}
TOLERANCE_RAD = 0.01
"""Without domain randomization, or where its range is smaller, a camera may be off by
this much along and about each axis."""


@dataclasses.dataclass(frozen=True)
class Difference:
  """Distance of a camera from its place in the contract, and the limits of it."""

  shift: np.ndarray  # f64[3], m, along the axes named by ``axes``
  turn: np.ndarray  # f64[3], rad, about the camera's own x, y and z
  most_shift: float  # along each axis, m
  most_turn: float  # about each axis, rad
  axes: str

  def to_json(self) -> Json:
    """Returns the numbers in mm and degrees."""
    return {
      "shift_mm": (1e3 * self.shift).round(3).tolist(),
      "shift_axes": self.axes,
      "turn_deg": np.degrees(self.turn).round(4).tolist(),
      "most_shift_mm": 1e3 * self.most_shift,
      "most_turn_deg": math.degrees(self.most_turn),
    }


def place(contract: Json, name: str) -> tuple[np.ndarray, str]:
  """Returns the pose of a camera by the contract, and the entry that has it."""
  camera = contract["cameras"][name]
  entry = "pose_in_world" if "pose_in_world" in camera else "pose_in_flange"
  return from_json(camera[entry]), entry


def difference(contract: Json, name: str, pose: np.ndarray) -> Difference:
  """Compares the pose of a camera with the contract, as training varies it."""
  nominal, entry = place(contract, name)
  fixed = entry == "pose_in_world"
  shift = pose[:3, 3] - nominal[:3, 3]
  if not fixed:  # Training shifts it along its own axes.
    shift = nominal[:3, :3].T @ shift
  turn = Rotation.from_matrix(nominal[:3, :3].T @ pose[:3, :3]).as_rotvec()
  ranges = contract.get("randomization") or {}
  most = float(ranges.get("camera_shift", 0.0)) * (1.0 if fixed else WRIST_SHARE)
  return Difference(
    shift=shift,
    turn=turn,
    most_shift=max(most, TOLERANCE_M["global" if fixed else "wrist"]),
    most_turn=max(float(ranges.get("camera_turn", 0.0)), TOLERANCE_RAD),
    axes="world" if fixed else "camera",
  )


def check(contract: Json, name: str, pose: np.ndarray, lens: Lens) -> Difference:
  """Checks the pose and the field of view of a camera against the contract.

  Raises:
    ConfigError: One is outside of what the policy was trained for; the message names
      each number, its limit, and how to move the camera.
  """
  found = difference(contract, name, pose)
  off = [
    f"{1e3 * abs(value):.1f} mm off along {axis} (limit {1e3 * found.most_shift:.1f})"
    for axis, value in zip("xyz", found.shift, strict=True)
    if abs(value) > found.most_shift
  ]
  off += [
    f"{math.degrees(abs(value)):.2f} degrees off about its {axis} (limit "
    f"{math.degrees(found.most_turn):.2f})"
    for axis, value in zip("xyz", found.turn, strict=True)
    if abs(value) > found.most_turn
  ]
  if off:
    back = -1e3 * found.shift
    whose = "the world's" if found.axes == "world" else "its own"
    turn = -np.degrees(found.turn)
    raise ConfigError(
      f"the {name} camera is not where the policy was trained for: {', '.join(off)}; "
      f"move it by {_numbers(back, 1)} mm along {whose} x, y, z and turn it by "
      f"{_numbers(turn, 2)} degrees about its own x (right), y (down), z (forward), or "
      "train with larger --env.randomization.camera-shift and camera-turn"
    )
  _check_view(contract, name, lens)
  return found


def _check_view(contract: Json, name: str, lens: Lens) -> None:
  """Checks that the camera sees what the policy needs, around the optical axis."""
  try:
    images.Preparation(lens.to_json(), contract["cameras"][name])
  except DeviceError as error:
    raise ConfigError(f"{name} camera: {error}") from None


def to_json(pose: np.ndarray) -> Json:
  """Returns a pose as in the contract."""
  turn = Rotation.from_matrix(pose[:3, :3])
  return {
    "position_m": pose[:3, 3].round(9).tolist(),
    "quaternion_wxyz": turn.as_quat(canonical=True, scalar_first=True)
    .round(9)
    .tolist(),
  }


def from_json(value: Json) -> np.ndarray:
  """Returns the pose f64[4, 4] of an entry of the contract."""
  pose = np.eye(4)
  quat = np.asarray(value["quaternion_wxyz"], float)
  pose[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
  pose[:3, 3] = value["position_m"]
  return pose


def _numbers(values: np.ndarray, digits: int) -> str:
  return "(" + ", ".join(f"{x:+.{digits}f}" for x in values) + ")"
