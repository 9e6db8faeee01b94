"""The folder of an exported policy, checked for a robot before anything moves.

Nothing here imports JAX; ``policy_process`` loads the program.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError, FileError, one_line
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.sim import motors
from apnpql_jax.sim.names import ARM_JOINTS

CONTRACT = "contract.json"
VERSION = 1
"""The version of the contract that this module reads, ``deploy.export.VERSION``."""

_FIELDS = ("robot", "tool", "global_image", "wrist_image")
_LENGTH = 1e-4  # m; largest difference of the arm's geometry
_PERIODS = (0.05, 0.5)  # s


@dataclasses.dataclass(frozen=True)
class PolicyFolder:
  """A policy that fits the robot."""

  path: Path
  """The folder."""

  contract: dict[str, Any]
  """Its contract."""

  @property
  def program(self) -> Path:
    """The file with the program."""
    return self.path / self.contract["program"]["file"]

  @property
  def neutral(self) -> np.ndarray:
    """Joint angles at which episodes begin, f64[6]."""
    return np.array(self.contract["joints"]["neutral"][: len(ARM_JOINTS)], float)

  @property
  def begins_closed(self) -> bool:
    """Whether the gripper is closed when an episode begins."""
    gripper = self.contract["joints"]["gripper"]
    middle = (gripper["open_rad"] + gripper["closed_rad"]) / 2
    return self.contract["joints"]["neutral"][len(ARM_JOINTS)] > middle


def load(path: Path) -> PolicyFolder:
  """Reads a folder and checks that the policy can drive this arm.

  Raises:
    FileError: It is not an exported policy, or it is damaged.
    ConfigError: The policy needs what no sensor gives, or is for another arm, motor
      model or period.
  """
  folder = _read(path)
  try:
    _check(folder)
  except (KeyError, TypeError, IndexError) as error:
    raise _damaged(path, error) from None
  return folder


def _read(path: Path) -> PolicyFolder:
  try:
    contract = json.loads((path / CONTRACT).read_text(encoding="utf-8"))
  except FileNotFoundError:
    raise FileError(
      f"{str(path)!r} is not an exported policy; make one with apnpql export"
    ) from None
  except (OSError, ValueError) as error:
    raise _damaged(path, error) from None
  if not isinstance(contract, dict) or contract.get("contract") != VERSION:
    raise FileError(
      f"{str(path)!r} has another version of the contract than {VERSION}; export the "
      "policy again with this version of apnpql"
    )
  return PolicyFolder(path, contract)


def _damaged(path: Path, error: Exception) -> FileError:
  return FileError(
    f"{str(path / CONTRACT)!r} is damaged: {one_line(error)}; export the policy again"
  )


def _check(folder: PolicyFolder) -> None:
  contract, path = folder.contract, folder.path
  try:
    digest = hashlib.sha256(folder.program.read_bytes()).hexdigest()
  except OSError as error:
    raise FileError(f"{str(folder.program)!r} cannot be read: {error}") from None
  if digest != contract["program"]["sha256"]:
    raise FileError(
      f"{str(folder.program)!r} is not the program of its contract; export it again"
    )
  fields = contract["observation"]["fields"]
  missing = [name for name in _FIELDS if name not in fields]
  unknown = [name for name in fields if name not in _FIELDS]
  if missing or unknown:
    raise ConfigError(
      f"the policy in {path} needs {', '.join(unknown) or 'no images'}; export one "
      "that was trained with --obs pixels"
    )
  period = contract["control_period_s"]
  step = 0.005  # Training's; actions begin on its grid.
  if not _PERIODS[0] <= period <= _PERIODS[1] or abs(period / step % 1 - 0.5) < 0.499:
    raise ConfigError(
      f"the policy in {path} has a period of {period} s; the robot needs a multiple of "
      f"{step} s from {_PERIODS[0]} to {_PERIODS[1]} s"
    )
  _check_arm(folder)


def _check_arm(folder: PolicyFolder) -> None:
  """Checks joints, geometry and motor model."""
  contract, model = folder.contract, ArmModel()
  if tuple(contract["joints"]["state"][:6]) != ARM_JOINTS:
    raise ConfigError(f"the policy in {folder.path} is for an arm with other joints")
  if contract["joints"].get("ranges", [])[:6] != model.joint_range.tolist():
    raise ConfigError(
      f"the policy in {folder.path} is for an arm with other ranges of its joints"
    )
  position, rotation = model.flange_pose(folder.neutral)
  tool = rotation.T @ (model.tool_position(folder.neutral) - position)
  given = np.array(contract["frames"]["tool_in_flange"]["position_m"])
  base = contract["frames"]["base_in_world"]["position_m"]
  if np.abs(tool - given).max() > _LENGTH or np.abs(base).max() > _LENGTH:
    raise ConfigError(f"the policy in {folder.path} is for another arm or gripper")
  motor = contract["action"]["motor_model"]
  ours = motors.VELOCITY_GAIN, motors.MAX_ACCELERATION
  theirs = motor["gain_1_per_s"], motor["acceleration_limit_rad_per_s2"]
  if ours != theirs or contract["action"]["high"][:6] != [motors.MAX_VELOCITY] * 6:
    raise ConfigError(
      f"the policy in {folder.path} was trained with other motors; export it with this "
      "version of apnpql"
    )
