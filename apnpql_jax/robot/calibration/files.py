"""The file of a calibration."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.errors import FileError, UserError, one_line
from apnpql_jax.robot.calibration import limits
from apnpql_jax.robot.calibration.lenses import Lens

Json = dict[str, Any]

FORMAT = "apnpql-calibration"
VERSION = 1


@dataclasses.dataclass(frozen=True)
class CalibratedCamera:
  """A camera: which one, its lens, and where it is."""

  serial: str
  lens: Lens
  entry: str
  """pose_in_world or pose_in_flange."""

  pose: np.ndarray
  """Pose of the optical frame f64[4, 4] in the world or in the flange."""

  about: Json
  """Residuals, difference from the contract, and how it was found."""


@dataclasses.dataclass(frozen=True)
class Calibration:
  """Calibrated cameras by their names in the contract."""

  created: str
  contract_sha256: str
  """Hash of the contract that it was made with; others may have the same cameras."""

  board: str
  cameras: Mapping[str, CalibratedCamera]


def save(path: Path, calibration: Calibration) -> None:
  """Writes a calibration.

  Raises:
    FileError: The file cannot be written.
  """
  value = {
    "format": FORMAT,
    "version": VERSION,
    "created": calibration.created,
    "contract_sha256": calibration.contract_sha256,
    "board": calibration.board,
    "cameras": {
      name: {
        "serial": camera.serial,
        "lens": camera.lens.to_json(),
        camera.entry: limits.to_json(camera.pose),
        **camera.about,
      }
      for name, camera in calibration.cameras.items()
    },
  }
  try:
    with replacing(path) as part:
      part.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")
  except OSError as error:
    raise FileError(f"cannot write {path}: {error.strerror or error}") from None


def read(path: Path) -> Calibration:
  """Reads a calibration, for whichever contract.

  Raises:
    FileError: The file is missing, damaged, or not a calibration.
  """
  try:
    value = json.loads(path.read_text(encoding="utf-8"))
    if value["format"] != FORMAT or value["version"] != VERSION:
      raise FileError(f"its format is not {FORMAT} {VERSION}")
    cameras = {name: _camera(x) for name, x in value["cameras"].items()}
    texts = (value[name] for name in ("created", "contract_sha256", "board"))
    return Calibration(*map(str, texts), cameras)
  except OSError as error:
    raise FileError(
      f"cannot read {path}: {error.strerror or error}; make it with apnpql robot "
      "calibrate"
    ) from None
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  except (ValueError, KeyError, TypeError, AttributeError) as error:
    raise FileError(f"{path} is damaged: {one_line(error)}") from None


def load(
  path: Path | str, contract: Json, serials: Mapping[str, str] | None = None
) -> Calibration:
  """Reads the calibration of the cameras of a contract.

  Args:
    path: The file.
    contract: That of the policy.
    serials: Camera -> serial number of the one that is connected.

  Raises:
    FileError: The file is missing or damaged, lacks a camera, or is of another one.
    ConfigError: A camera is not where the policy was trained for.
  """
  path = Path(path)
  calibration = read(path)
  if missing := sorted(contract["cameras"].keys() - calibration.cameras.keys()):
    raise FileError(
      f"{path} lacks the {' and '.join(missing)} camera: calibrate it with apnpql "
      "robot calibrate"
    )
  for name in contract["cameras"]:
    camera = calibration.cameras[name]
    _, entry = limits.place(contract, name)
    if camera.entry != entry:
      raise FileError(f"{path}: the {name} camera has no {entry}")
    if serials is not None and serials[name] != camera.serial:
      raise FileError(
        f"the calibration is of the {name} camera {camera.serial}, but {serials[name]} "
        "is connected: connect that camera, or calibrate this one"
      )
    limits.check(contract, name, camera.pose, camera.lens)
  return calibration


def hash_of(contract: Json) -> str:
  """Returns the SHA-256 of a contract's content."""
  text = json.dumps(contract, sort_keys=True, separators=(",", ":"))
  return hashlib.sha256(text.encode()).hexdigest()


def _camera(value: Json) -> CalibratedCamera:
  entry = "pose_in_world" if "pose_in_world" in value else "pose_in_flange"
  pose = limits.from_json(value[entry])
  if not np.isfinite(pose).all():
    raise FileError(f"{entry} is not finite")
  known = {"serial", "lens", entry}
  return CalibratedCamera(
    serial=str(value["serial"]),
    lens=Lens.from_json(value["lens"]),
    entry=entry,
    pose=pose,
    about={name: x for name, x in value.items() if name not in known},
  )
