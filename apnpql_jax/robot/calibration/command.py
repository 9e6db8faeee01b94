"""Calibration of the cameras, from recorded views or with connected devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import dataclasses
import datetime
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.atomic import check_writable
from apnpql_jax.console import reporting
from apnpql_jax.errors import ConfigError, FileError, UserError, check_name
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.calibration import (
  boards,
  files,
  lenses,
  limits,
  overlay,
  solve,
  views,
)
from apnpql_jax.robot.calibration.boards import Board
from apnpql_jax.robot.calibration.files import CalibratedCamera, Calibration
from apnpql_jax.robot.calibration.problem import Problem
from apnpql_jax.robot.calibration.solve import Solution
from apnpql_jax.robot.calibration.views import MeasuredArm, NativeCamera, Views
from apnpql_jax.robot.vendors import opencv

Json = dict[str, Any]

BOARD_ON = ("tool", "table")


@dataclasses.dataclass(frozen=True)
class _Found:
  """A solved camera with the views that it was solved from."""

  camera: CalibratedCamera
  solution: Solution
  problem: Problem
  views: Views
  rows: np.ndarray  # numbers of the views of ``problem``
  flanges: np.ndarray  # f64[rows, 4, 4]


def calibrate(
  contract: Json,
  folder: Path,
  out: Path,
  *,
  board: str = Board().text,
  board_on: str = "tool",
  arm: MeasuredArm | None = None,
  cameras: Mapping[str, NativeCamera] | None = None,
  serials: Mapping[str, str] | None = None,
  ask: Callable[[str], str] = input,
  overwrite: bool = False,
) -> Json:
  """Calibrates the cameras whose views are in a folder, and writes the calibration.

  Args:
    contract: That of the policy.
    folder: Folder with a folder of views for each camera, ``wrist`` and ``global``.
    out: File to write, such as calibration.json. Pictures of real and simulated views
      are written next to it. With ``overwrite``, cameras without views are kept.
    board: The printed board, see ``boards.parse``.
    board_on: Where the board is in views of the global camera: on the "tool", or on the
      "table" where the wrist camera saw it.
    arm: With ``cameras``: take new views first, with this arm.
    cameras: Camera by its name -> the connected one.
    serials: Camera by its name -> the serial number that its views must have.
    ask: See ``views.record``.
    overwrite: Replace an earlier calibration.

  Returns:
    The file, and for each camera its residuals and difference from the contract.

  Raises:
    UserError: The views do not suffice, or a camera is not where the policy was trained
      for; nothing is written then but pictures.
  """
  opencv()
  kind = boards.parse(board)
  check_name("--board-on", board_on, BOARD_ON)
  check_writable(out.absolute().parent)
  if out.exists() and not overwrite:
    raise FileError(f"{out} exists; replace it with --overwrite, or name another file")
  if cameras:
    if arm is None:
      raise ConfigError("cameras without an arm give no views")
    for name, camera in cameras.items():  # All of them, before the first view.
      views.check_new(folder / name, camera)
    for name, camera in cameras.items():
      views.record(folder / name, kind, arm, camera, ask=ask)
  found = _calibrate_each(contract, folder, kind, board_on, serials)
  kept = _kept(contract, out, found)
  pictures = [_picture(contract, name, x, out) for name, x in found.items()]
  checked = {name: _checked(contract, name, x.camera) for name, x in found.items()}
  files.save(
    out,
    Calibration(
      created=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
      contract_sha256=files.hash_of(contract),
      board=kind.text,
      cameras=kept | checked,
    ),
  )
  return {
    "file": str(out),
    "pictures": [str(x) for x in pictures if x is not None],
    **{name: _summary(x.about) for name, x in checked.items()},
  }


def _names(contract: Json, folder: Path) -> list[str]:
  """Returns the cameras with views, the wrist's first: it finds a board on the table.

  Raises:
    UserError: There are none.
  """
  known = sorted(contract["cameras"], reverse=True)
  if not known:
    raise ConfigError("the policy sees no images, so no camera is to be calibrated")
  names = [name for name in known if (folder / name).is_dir()]
  if not names:
    wanted = " or ".join(str(folder / name) for name in known)
    raise FileError(f"there are no views in {wanted}")
  return names


def _kept(
  contract: Json, out: Path, found: Mapping[str, _Found]
) -> dict[str, CalibratedCamera]:
  """Returns the cameras of an earlier calibration, if some have no new views.

  If all have new views, the file is not read and may be damaged.
  """
  if not out.exists() or contract["cameras"].keys() <= found.keys():
    return {}
  return dict(files.read(out).cameras)


def _calibrate_each(
  contract: Json,
  folder: Path,
  board: Board,
  board_on: str,
  serials: Mapping[str, str] | None,
) -> dict[str, _Found]:
  """Returns the cameras with views, by name; errors begin with the name."""
  found: dict[str, _Found] = {}
  for name in _names(contract, folder):
    try:
      if serials is not None:
        views.check_serial(folder / name, serials[name])
      found[name] = _calibrate_one(
        contract, name, folder / name, board, board_on, found
      )
    except UserError as error:
      raise type(error)(f"{name} camera: {error}") from None
  return found


def _checked(contract: Json, name: str, camera: CalibratedCamera) -> CalibratedCamera:
  """Returns a camera with its difference from the contract.

  Raises:
    ConfigError: The camera is not where the policy was trained for.
  """
  difference = limits.check(contract, name, camera.pose, camera.lens)
  about = camera.about | {"difference": difference.to_json()}
  return dataclasses.replace(camera, about=about)


def _calibrate_one(
  contract: Json,
  name: str,
  folder: Path,
  board: Board,
  board_on: str,
  earlier: Mapping[str, _Found],
) -> _Found:
  """Returns the camera of a folder of views."""
  shown = views.load(folder)
  seen = views.seen_in(board, shown)
  rows = np.array([*seen])
  arm = ArmModel()
  flanges = np.stack([_matrix(*arm.flange_pose(x)) for x in shown.joints[rows]])
  lens, source = shown.lens, "camera"
  if lens is None:
    lens, source = lenses.estimate(board, [*seen.values()], shown.size), "views"
  _, entry = limits.place(contract, name)
  if entry == "pose_in_flange":
    problem = Problem(board, lens, [*seen.values()], np.linalg.inv(flanges))
    solution = solve.solve(problem)
  elif board_on == "tool":
    problem = Problem(board, lens, [*seen.values()], flanges)
    solution = solve.solve(problem)
  else:
    tables = [x for x in earlier.values() if x.camera.entry == "pose_in_flange"]
    if not tables:
      raise ConfigError(
        "with the board on the table, its pose comes from the wrist camera: take views "
        "with that, too, without moving the board"
      )
    problem = Problem(
      board, lens, [*seen.values()], np.tile(np.eye(4), (len(rows), 1, 1))
    )
    solution = solve.solve_fixed(problem, tables[0].solution.board)
  about = {
    "lens_from": source,
    "residuals": solution.residuals
    | {"outliers": [shown.names[rows[i]] for i in solution.residuals["outliers"]]},
  }
  camera = CalibratedCamera(shown.serial, lens, entry, solution.camera, about)
  return _Found(camera, solution, problem, shown, rows, flanges)


def _picture(contract: Json, name: str, found: _Found, out: Path) -> Path | None:
  """Writes the picture of a view, or prints why there is none; returns its path."""
  path = out.with_name(f"{out.stem}_{name}.png")
  # Of the views that were used, that with the most corners.
  kept = np.flatnonzero(found.solution.kept)
  best = max(kept, key=lambda i: len(found.problem.seen[i].ids))
  fixed = found.camera.entry == "pose_in_world"
  pose = found.solution.camera if fixed else found.flanges[best] @ found.solution.camera
  # By the equation of ``solve``, in the world.
  inverse = np.linalg.inv(found.solution.camera)
  board = pose @ inverse @ found.problem.motion[best] @ found.solution.board
  corners = found.problem.board.corners @ board[:3, :3].T + board[:3, 3]
  with reporting("compare real and simulated views"):
    overlay.write(
      path,
      contract["cameras"][name],
      name,
      pose,
      found.camera.lens,
      found.views.images[found.rows[best]],
      found.views.joints[found.rows[best]],
      corners,
    )
    return path
  return None


def _summary(about: Json) -> Json:
  """Returns the numbers to show of a camera."""
  residuals, difference = about["residuals"], about["difference"]
  held_out = residuals["held_out"]
  return {
    "views": residuals["views"],
    "error_px": round(residuals["px"], 3),
    "error_mm": round(held_out["mm"], 2),
    "error_deg": round(held_out["deg"], 3),
    "off_mm": difference["shift_mm"],
    "off_deg": difference["turn_deg"],
  }


def _matrix(pos: np.ndarray, mat: np.ndarray) -> np.ndarray:
  pose = np.eye(4)
  pose[:3, :3], pose[:3, 3] = mat, pos
  return pose
