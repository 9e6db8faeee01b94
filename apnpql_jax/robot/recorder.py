"""The log of a session: a dataset of LeRobot with what the policy saw and did."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.data import lerobot
from apnpql_jax.robot.protocols import CAMERAS, Frame

ROBOT_TYPE = "ur5e_rh_p12_rn"
_COMMAND = "observation.command"
_WRENCH = "observation.wrench"
_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")


class Recorder:
  """Writer of a log, which writes each episode at its end: encoding takes long."""

  def __init__(
    self,
    folder: Path,
    contract: dict[str, Any],
    *,
    judged: bool,
    environment: Sequence[str] = (),
    devices: dict[str, Any] | None = None,
  ):
    """Makes the folder.

    Args:
      folder: Folder to make.
      contract: That of the policy.
      judged: Whether the success of an episode is known, see ``lerobot.Writer``.
      environment: Names of the numbers in the state of the scene, if it is known; see
        ``conversion.state_names``.
      devices: What the devices say of themselves, see ``Device.describe``.

    Raises:
      ConfigError: A package is missing.
      FileError: The folder exists or cannot be written.
    """
    joints = contract["joints"]["state"]
    cameras = contract["cameras"]
    self._task, self._rows, self._count = contract["task"], [], 0
    known = {lerobot.ENVIRONMENT: tuple(environment)} if environment else {}
    self._writer = lerobot.Writer(
      folder,
      fps=1 / contract["control_period_s"],
      vectors={
        lerobot.STATE: tuple(joints),
        lerobot.ACTION: tuple(contract["action"]["order"]),
        _COMMAND: tuple(joints[:6]),
        _WRENCH: _AXES,
        lerobot.TIMES: (*CAMERAS, "joints", "gripper", "action"),
        **known,
      },
      images={
        f"{lerobot.IMAGES}{name}": (
          cameras[name]["height"],
          cameras[name]["width"],
        )
        for name in CAMERAS
      },
      robot_type=ROBOT_TYPE,
      about={"contract": contract, "devices": devices or {}},
      judged=judged,
    )

  def __enter__(self) -> Recorder:
    return self

  def __exit__(self, *error: object) -> None:
    self._writer.close()

  def add(
    self,
    begin: float,
    now: float,
    state: Any,
    action: np.ndarray,
    frames: Sequence[Frame],
    environment: np.ndarray | None = None,
  ) -> None:
    """Keeps an instant.

    Args:
      begin: When the episode began, s.
      now: When the action was chosen, s.
      state: Record "state" of the board.
      action: The action f32[7].
      frames: What the cameras saw.
      environment: State of the scene at that moment f32[k], if the log has it.
    """
    times = [*(x.time for x in frames), state["time"], state["gripper_time"], now]
    row = {
      lerobot.STATE: np.append(state["position"], state["gripper"]),
      lerobot.ACTION: action,
      _COMMAND: state["command"],
      _WRENCH: state["wrench"],
      lerobot.TIMES: np.array(times) - begin,
    }
    for name, frame in zip(CAMERAS, frames, strict=True):
      row[f"{lerobot.IMAGES}{name}"] = frame.image
    if environment is not None:
      row[lerobot.ENVIRONMENT] = environment
    self._rows.append(row)

  def end_episode(self, success: bool | None) -> int | None:
    """Writes the episode, and returns its index; None without instants."""
    rows, self._rows = self._rows, []
    for row in rows:
      self._writer.add(row)
    if not rows:
      return None
    self._writer.end_episode(self._task, success)
    self._count += 1
    return self._count - 1
