"""Views of a board: images and the joint angles at which they were taken.

A folder has ``camera.json`` (serial number and, if known, the lens), and for each view
a PNG and a JSON file of the same name with the joint angles in rad.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import json
from pathlib import Path
import time
from typing import Any, Protocol

import numpy as np

from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, FileError, one_line
from apnpql_jax.robot.calibration import boards
from apnpql_jax.robot.calibration.boards import Board
from apnpql_jax.robot.calibration.lenses import Lens
from apnpql_jax.robot.protocols import ArmState, Device, Frame

Json = dict[str, Any]

CAMERA = "camera.json"
_STILL = 0.005  # rad/s; slower joints are at rest
_SAME = 5e-4  # rad; nearer joint angles are the same
_SETTLE_S = 0.3  # at rest, before the image is taken
_PATIENCE_S = 5.0


class MeasuredArm(Device, Protocol):
  """An arm that is read; it need not take commands."""

  def get_observation(self) -> ArmState:
    """Returns the newest measurement without waiting."""
    ...


class NativeCamera(Device, Protocol):
  """A camera that also gives its images as they are, for calibration."""

  def get_native(self) -> Frame:
    """Returns the newest image of the sensor: neither undistorted nor cropped."""
    ...

  def lens(self) -> Json:
    """Returns the maker's intrinsics of these images, see ``Lens.from_json``."""
    ...


@dataclasses.dataclass(frozen=True)
class Views:
  """Views of one camera."""

  serial: str
  lens: Lens | None
  names: list[str]
  joints: np.ndarray  # f64[n, 6], rad
  images: list[np.ndarray]  # u8[H, W, 3], all of one size

  @property
  def size(self) -> tuple[int, int]:
    """Height and width of the images."""
    height, width = self.images[0].shape[:2]
    return height, width


def check_serial(folder: Path, serial: str) -> None:
  """Raises ``FileError`` if the views in a folder are of another camera."""
  found, _ = _camera(folder)
  if found != serial:
    raise FileError(
      f"the views in {folder} are of {found}, but the robot has {serial}: take new ones"
    )


def load(folder: Path) -> Views:
  """Reads a folder of views.

  Raises:
    FileError: A file is missing or damaged, or an image has another size.
  """
  serial, lens = _camera(folder)
  paths = sorted(folder.glob("*.png"))
  if not paths:
    raise FileError(f"{folder} has no views: a PNG and a JSON file for each")
  images = [_image(path) for path in paths]
  joints = np.array([_joints(path.with_suffix(".json")) for path in paths])
  size = images[0].shape[:2] if lens is None else (lens.height, lens.width)
  for path, image in zip(paths, images, strict=True):
    if image.shape[:2] != size:
      raise FileError(
        f"{path} has {image.shape[1]}x{image.shape[0]} pixels, not {size[1]}x{size[0]} "
        "as the camera's lens or the other views"
      )
  return Views(serial, lens, [path.stem for path in paths], joints, images)


def _camera(folder: Path) -> tuple[str, Lens | None]:
  """Returns the serial number and the lens of a folder of views."""
  try:
    about = json.loads((folder / CAMERA).read_text(encoding="utf-8"))
    serial, lens = str(about["serial"]), about.get("lens")
    return serial, None if lens is None else Lens.from_json(lens)
  except OSError as error:
    raise FileError(
      f"cannot read {folder / CAMERA}: {error.strerror or error}"
    ) from None
  except (ValueError, KeyError, TypeError, AttributeError) as error:
    raise FileError(
      f'{folder / CAMERA} must have "serial" and may have "lens": {one_line(error)}'
    ) from None


def check_new(folder: Path, camera: Any) -> None:
  """Checks that new views can be taken, see ``record``.

  Raises:
    ConfigError: The camera is simulated.
    FileError: The folder exists.
  """
  if not hasattr(camera, "get_native"):
    raise ConfigError(f"the {folder.name} camera gives no images of its sensor")
  if folder.exists():
    raise FileError(f"{folder} exists; name another folder for new views")


def record(
  folder: Path,
  board: Board,
  arm: MeasuredArm,
  camera: NativeCamera,
  *,
  ask: Callable[[str], str] = input,
) -> None:
  """Takes views with connected devices, and writes them to a new folder.

  The arm is moved by hand, in free drive; nothing here moves it.

  Args:
    folder: Folder to make.
    board: The board, to tell at once whether a view shows it.
    arm: The arm, connected.
    camera: The camera, connected.
    ask: Shows a text and returns what the user types: nothing for a view, d when done.
      Without a view, no folder is made.

  Raises:
    DeviceError: A device fails.
    UserError: See ``check_new``; or the folder cannot be written.
  """
  from PIL import Image

  check_new(folder, camera)
  about = {"serial": str(camera.describe()["serial_number"]), "lens": camera.lens()}
  count = 0
  while True:
    try:
      text = f"{folder.name} {count + 1}: move the arm; Enter, or d when done: "
      if ask(text).strip().lower() == "d":
        return
    except EOFError:  # Nobody can answer.
      return
    if (taken := _at_rest(arm, camera)) is None:
      print_line("arm or image did not come to rest; hold the arm still")
      continue
    joints, image = taken
    seen = boards.detect(board, image)
    if seen is None:
      print_line("the board is not in view; try another posture")
      continue
    folder.mkdir(parents=True, exist_ok=True)
    if not count:
      text = json.dumps(about, indent=2) + "\n"
      (folder / CAMERA).write_text(text, encoding="utf-8")
    Image.fromarray(image).save(folder / f"{count:03d}.png")
    text = json.dumps({"joints": joints.tolist()}) + "\n"
    (folder / f"{count:03d}.json").write_text(text, encoding="utf-8")
    count += 1
    print_line(f"view {count}: {len(seen.ids)} of {len(board.corners)} corners")


def _at_rest(
  arm: MeasuredArm, camera: NativeCamera
) -> tuple[np.ndarray, np.ndarray] | None:
  """Returns joint angles and an image of one instant of rest, or None without one."""
  began = since = time.monotonic()
  start = arm.get_observation().position
  while time.monotonic() < began + _PATIENCE_S:
    state, frame = arm.get_observation(), camera.get_native()
    moved = np.abs(state.position - start).max() > _SAME
    if moved or np.abs(state.velocity).max() > _STILL:
      since = time.monotonic()
      start = state.position
    elif frame.time > since + _SETTLE_S and state.time > since + _SETTLE_S:
      return state.position, frame.image
    time.sleep(0.02)
  return None


def _image(path: Path) -> np.ndarray:
  from PIL import Image

  try:
    with Image.open(path) as image:
      return np.asarray(image.convert("RGB"))
  except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
    raise FileError(f"cannot read {path}: {one_line(error)}") from None


def _joints(path: Path) -> np.ndarray:
  try:
    joints = np.array(json.loads(path.read_text(encoding="utf-8"))["joints"], float)
  except OSError as error:
    raise FileError(f"cannot read {path}: {error.strerror or error}") from None
  except (ValueError, KeyError, TypeError) as error:
    raise FileError(f'{path} must have "joints": {one_line(error)}') from None
  if joints.shape != (6,) or not np.isfinite(joints).all():
    raise FileError(f"{path}: joints must be six numbers")
  if np.abs(joints).max() > 2 * np.pi + 0.1:
    raise FileError(f"{path}: a joint angle of {np.abs(joints).max():.1f}: use rad")
  return joints


def seen_in(board: Board, views: Views) -> dict[int, boards.Seen]:
  """Returns the number of each view that shows the board -> its corners.

  Raises:
    ConfigError: No view shows it; the message names what they show instead.
  """
  found = {i: boards.detect(board, image) for i, image in enumerate(views.images)}
  known = {i: seen for i, seen in found.items() if seen is not None}
  if not known:
    for name, image in zip(views.names, views.images, strict=True):
      if (other := boards.other_board(board, image)) is not None:
        raise ConfigError(
          f"no view shows the board {board.text}; view {name} shows {other}: name "
          "the printed board with --board"
        )
    raise ConfigError(
      f"no view shows the board {board.text}: light it evenly and bring it closer"
    )
  return known
