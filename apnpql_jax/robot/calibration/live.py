"""Calibration of the cameras of a cell, with its devices or from recorded views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
from pathlib import Path
from typing import Any

from apnpql_jax.robot.calibration.boards import Board
from apnpql_jax.robot.calibration.command import calibrate
from apnpql_jax.robot.devices import connected

Json = dict[str, Any]

SIZE = 720, 1280
"""Height and width of the mode for views: D435 and D455 have it, and markers are small.
The pose of the camera holds for its other modes, too."""


def calibrate_cell(
  contract: Json,
  folder: Path,
  out: Path,
  *,
  host: str,
  serials: Mapping[str, str],
  recorded: bool,
  board: str = Board().text,
  board_on: str = "tool",
  ask: Callable[[str], str] = input,
  overwrite: bool = False,
) -> Json:
  """Calibrates the cameras of a cell.

  Args:
    contract: That of the policy.
    folder: Folder of the views.
    out: See ``calibrate``.
    host: Address of the arm's controller.
    serials: Camera by its name -> its serial number.
    recorded: The folder has the views; otherwise they are taken with the devices.
    board: See ``calibrate``.
    board_on: See ``calibrate``.
    ask: See ``views.record``.
    overwrite: See ``calibrate``.

  Raises:
    UserError: See ``calibrate``; also if a device is missing.
  """
  options: Json = {"board": board, "board_on": board_on, "overwrite": overwrite}
  options |= {"serials": serials, "ask": ask}
  if recorded:
    return calibrate(contract, folder, out, **options)

  from apnpql_jax.robot.drivers.realsense import RealSense
  from apnpql_jax.robot.drivers.ur_listener import Listener

  names = sorted(contract["cameras"], reverse=True)
  arm = Listener(host)
  cameras = {
    name: RealSense(serials[name], view=contract["cameras"][name], size=SIZE)
    for name in names
  }
  with contextlib.ExitStack() as stack:
    for device in (arm, *cameras.values()):
      stack.enter_context(connected(device))
    return calibrate(contract, folder, out, arm=arm, cameras=cameras, **options)
