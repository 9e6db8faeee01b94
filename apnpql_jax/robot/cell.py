"""The description of a robot cell, ``robot.toml``: addresses, payload and workspace."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
import tomllib
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError, one_line
from apnpql_jax.robot.limits import Limits
from apnpql_jax.robot.virtual_arm import Admittance
from apnpql_jax.sim.motors import MAX_VELOCITY

EXAMPLE = """\
calibration = "calibration.json"   # written by apnpql robot calibrate

[arm]
host = "192.168.0.10"
payload_kg = 0.488                 # gripper, camera and their mount
payload_cog_m = [0.0, 0.0, 0.05]   # in the flange

[gripper]
port = "/dev/ttyUSB0"

[cameras]                          # serial numbers
global = "123456789012"
wrist = "210987654321"

[workspace]                        # of the tool, in the frame of the contract
low_m = [0.25, -0.35, 0.005]
high_m = [0.70, 0.35, 0.45]
"""
"""A complete file."""

_JOINT_MARGIN = 0.05  # rad from the end of a joint's range
_RANGES = {
  "limits.joint_velocity_rad_per_s": (0.1, MAX_VELOCITY),
  "admittance.contact_stiffness_n_per_m": (5e3, 5e4),
  "admittance.lag_s": (0.03, 0.1),
}
"""Key -> least and largest value.

Slower than 0.1 rad/s, the way to the neutral pose does not end in time. The damping in
contact is 1.5 times stiffness times lag (``virtual_arm``). With too little, contacts
buzz. At the upper ends, 30 N move the tool by only 4 mm/s. servoJ alone lags by 0.03 s.
"""


@dataclasses.dataclass(frozen=True)
class Cell:
  """A robot cell. The defaults are those of the simulated robot."""

  path: Path | None = None
  """The file, if it comes from one."""

  calibration: Path | None = None
  """File of the calibration."""

  arm_host: str = ""
  """Name or address of the arm's controller."""

  payload_kg: float = 0.488
  """Mass of gripper and camera, kg."""

  payload_cog_m: tuple[float, ...] = (0.0, 0.0, 0.05)
  """Center of gravity of gripper and camera in the flange, m."""

  gripper_port: str = ""
  """Serial port of the gripper."""

  cameras: dict[str, str] = dataclasses.field(default_factory=dict)
  """Name of each camera of the contract -> its serial number."""

  workspace_low_m: tuple[float, ...] = (0.20, -0.40, 0.0)
  """Lowest position of the tool in the world, m."""

  workspace_high_m: tuple[float, ...] = (0.75, 0.40, 0.55)
  """Highest position of the tool in the world, m."""

  joint_velocity_rad_per_s: float = MAX_VELOCITY
  """Limit of each joint's velocity, at most that of the training."""

  contact_stiffness_n_per_m: float = Admittance.stiffness
  """Stiffness of the hardest contact to expect, N/m."""

  lag_s: float = Admittance.lag
  """Delay between a command and the force that it causes, s."""

  def limits(self, contract: dict[str, Any]) -> Limits:
    """Returns the limits of the cell for a policy."""
    joints = np.array(contract["joints"]["ranges"][:6], float)
    return Limits(
      box=np.array([self.workspace_low_m, self.workspace_high_m]).T,
      joints=joints + [_JOINT_MARGIN, -_JOINT_MARGIN],
      velocity=self.joint_velocity_rad_per_s,
      period=contract["control_period_s"],
    )

  def admittance(self) -> Admittance:
    """Returns how the virtual arm answers contacts."""
    return Admittance(self.contact_stiffness_n_per_m, self.lag_s)


_KEYS = {
  "calibration": ("calibration", "text"),
  "arm.host": ("arm_host", "text"),
  "arm.payload_kg": ("payload_kg", "number"),
  "arm.payload_cog_m": ("payload_cog_m", "numbers"),
  "gripper.port": ("gripper_port", "text"),
  "cameras.global": ("global", "text"),
  "cameras.wrist": ("wrist", "text"),
  "workspace.low_m": ("workspace_low_m", "numbers"),
  "workspace.high_m": ("workspace_high_m", "numbers"),
  "limits.joint_velocity_rad_per_s": ("joint_velocity_rad_per_s", "number"),
  "admittance.contact_stiffness_n_per_m": ("contact_stiffness_n_per_m", "number"),
  "admittance.lag_s": ("lag_s", "number"),
}
"""Key -> field (or camera) and kind."""

_OPTIONAL = ("limits.", "admittance.")
"""Beginnings of keys that may be absent."""

_KINDS = {
  "text": "text in quotes",
  "number": "a positive number",
  "numbers": "three numbers, as [0.1, 0.2, 0.3]",
}


def load_cell(path: Path) -> Cell:
  """Reads and checks the file of a cell.

  Raises:
    ConfigError: It is missing or unreadable, or a key is missing, unknown or invalid;
      the message names the key and what it needs.
  """
  try:
    given = _flat(tomllib.loads(path.read_text(encoding="utf-8")))
  except FileNotFoundError:
    raise ConfigError(
      f"{path} does not exist; --cell names the file of the cell, see docs/robot.md"
    ) from None
  except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
    raise ConfigError(f"{path} cannot be read: {one_line(error)}") from None
  for key in given:
    if key not in _KEYS:
      raise ConfigError(f"{path}: unknown key {key}; valid: {', '.join(_KEYS)}")
  fields: dict[str, Any] = {"path": path, "cameras": {}}
  for key, (field, kind) in _KEYS.items():
    if key not in given:
      if key.startswith(_OPTIONAL):
        continue
      raise ConfigError(f"{path} has no {key}; add it as {_KINDS[kind]}")
    value = _checked(path, key, kind, given[key])
    target = fields["cameras"] if key.startswith("cameras.") else fields
    target[field] = value
  fields["calibration"] = path.parent / fields["calibration"]
  cell = Cell(**fields)
  if not all(np.less(cell.workspace_low_m, cell.workspace_high_m)):
    raise ConfigError(f"{path}: workspace.low_m must be below workspace.high_m")
  if len(set(cell.cameras.values())) < len(cell.cameras):
    raise ConfigError(f"{path}: cameras.global and cameras.wrist are the same camera")
  return cell


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
  """Returns the values of nested tables by dotted key."""
  flat: dict[str, Any] = {}
  for key, value in tree.items():
    if isinstance(value, dict):
      flat |= _flat(value, f"{prefix}{key}.")
    else:
      flat[prefix + key] = value
  return flat


def _checked(path: Path, key: str, kind: str, value: Any) -> Any:
  """Returns a value of its kind, or raises ``ConfigError``."""
  if kind == "text" and isinstance(value, str) and value.strip():
    return value
  if kind == "number" and _is_number(value) and value > 0:
    least, most = _RANGES.get(key, (0.0, math.inf))
    if not least <= value <= most:
      raise ConfigError(f"{path}: {key} = {value!r} must be {least:g} to {most:g}")
    return float(value)
  if kind == "numbers" and isinstance(value, list) and len(value) == 3:
    if all(_is_number(x) for x in value):
      return tuple(map(float, value))
  raise ConfigError(f"{path}: {key} = {value!r} must be {_KINDS[kind]}")


def _is_number(value: Any) -> bool:
  is_number = isinstance(value, int | float) and type(value) is not bool
  return is_number and math.isfinite(value)
