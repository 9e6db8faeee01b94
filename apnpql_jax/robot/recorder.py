"""The log of a session: a dataset of LeRobot with what the policy saw and did."""

from __future__ import annotations

from collections.abc import Sequence
import importlib
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError
from apnpql_jax.robot.protocols import Frame
from apnpql_jax.robot.supervisor import CAMERAS

ROBOT_TYPE = "ur5e_rh_p12_rn"
_COMMAND = "observation.command"
_WRENCH = "observation.wrench"
_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


def check_available() -> None:
  """Raises ``ConfigError`` if logs cannot be written or read."""
  lerobot().check_available()


class Recorder:
  """Writes episodes when they end, because encoding takes longer than a period."""

  def __init__(self, folder: Path, contract: dict[str, Any]):
    """Makes the folder.

    Raises:
      ConfigError: A package is missing.
      FileError: The folder exists or cannot be written.
    """
    self._lerobot = lerobot()
    joints = contract["joints"]["state"]
    cameras = contract["cameras"]
    self._task, self._rows = contract["task"], []
    self._writer = self._lerobot.Writer(
      folder,
      fps=1 / contract["control_period_s"],
      vectors={
        self._lerobot.STATE: tuple(joints),
        self._lerobot.ACTION: tuple(contract["action"]["order"]),
        _COMMAND: tuple(joints[:6]),
        _WRENCH: _AXES,
      },
      images={
        f"{self._lerobot.IMAGES}{name}": (
          cameras[name]["height"],
          cameras[name]["width"],
        )
        for name in CAMERAS
      },
      robot_type=ROBOT_TYPE,
      about={"contract": contract},
    )

  def __enter__(self) -> Recorder:
    return self

  def __exit__(self, *error: object) -> None:
    self._writer.close()

  def add(self, state: Any, action: np.ndarray, frames: Sequence[Frame]) -> None:
    """Keeps an instant: a record "state" of the board, the action, and the frames."""
    row = {
      self._lerobot.STATE: np.append(state["position"], state["gripper"]),
      self._lerobot.ACTION: action,
      _COMMAND: state["command"],
      _WRENCH: state["wrench"],
    }
    for name, frame in zip(CAMERAS, frames, strict=True):
      row[f"{self._lerobot.IMAGES}{name}"] = frame.image
    self._rows.append(row)

  def end_episode(self, success: bool) -> None:
    """Writes the episode, if it has instants."""
    rows, self._rows = self._rows, []
    for row in rows:
      self._writer.add(row)
    if rows:
      self._writer.end_episode(self._task, success)


def lerobot() -> Any:
  """Returns the package that reads and writes logs.

  Raises:
    ConfigError: A package that it needs is missing.
  """
  try:
    return importlib.import_module("apnpql_jax.data.lerobot")
  except ModuleNotFoundError as error:
    raise ConfigError(
      f"robot needs {error.name}: pip install 'apnpql-jax[robot]'"
    ) from error
