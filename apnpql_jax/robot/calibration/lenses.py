"""The lens of a camera: from points in its optical frame to pixels."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError
from apnpql_jax.robot.calibration.boards import Board, Seen
from apnpql_jax.robot.vendors import opencv

FEWEST_VIEWS = 8  # from which a lens is estimated


@dataclasses.dataclass(frozen=True)
class Lens:
  """Intrinsics in pixels of images of this size; the first pixel's center is 0, 0."""

  height: int
  width: int
  fx: float
  fy: float
  cx: float
  cy: float
  distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
  """k1, k2, p1, p2, k3 of OpenCV."""

  @property
  def matrix(self) -> np.ndarray:
    """The camera matrix f64[3, 3]."""
    return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], float)

  def project(self, points: np.ndarray) -> np.ndarray:
    """Returns the pixels f64[n, 2] of points f64[n, 3] in the optical frame."""
    pixels, _ = opencv().projectPoints(
      points, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion)
    )
    return pixels.reshape(-1, 2)

  def board_pose(self, board: Board, seen: Seen) -> np.ndarray:
    """Returns the pose of a board in the optical frame."""
    cv2 = opencv()
    corners, lens = board.corners[seen.ids], (self.matrix, np.array(self.distortion))
    _, turn, shift = cv2.solvePnP(corners, seen.pixels, *lens, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(corners, seen.pixels, *lens, turn, shift)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose

  def to_json(self) -> dict[str, Any]:
    """Returns the numbers for a file."""
    return dataclasses.asdict(self) | {"distortion": list(self.distortion)}

  @classmethod
  def from_json(cls, value: Any) -> Lens:
    """Parses the output of ``to_json``.

    Raises:
      ConfigError: A number is missing or impossible.
    """
    try:
      known = {field.name: value[field.name] for field in dataclasses.fields(cls)[:6]}
      distortion = tuple(map(float, value.get("distortion", (0.0,) * 5)))
      lens = cls(
        height=int(known.pop("height")),
        width=int(known.pop("width")),
        **{name: float(x) for name, x in known.items()},
        distortion=distortion,
      )
    except (KeyError, TypeError, ValueError, AttributeError):
      raise ConfigError(
        "a lens needs height, width, fx, fy, cx, cy and distortion, all numbers"
      ) from None
    numbers = [lens.fx, lens.fy, lens.cx, lens.cy, *distortion]
    possible = min(lens.height, lens.width, lens.fx, lens.fy) > 0
    if not possible or len(distortion) != 5 or not all(map(math.isfinite, numbers)):
      raise ConfigError("a lens has impossible numbers")
    return lens


def estimate(board: Board, seen: list[Seen], size: tuple[int, int]) -> Lens:
  """Returns the lens that explains views of a board; ``size`` is height and width.

  Raises:
    ConfigError: There are too few views.
  """
  if len(seen) < FEWEST_VIEWS:
    raise ConfigError(
      f"{len(seen)} views of the board do not determine the lens; take at least "
      f"{FEWEST_VIEWS}, or give the camera's own intrinsics in camera.json"
    )
  cv2 = opencv()
  height, width = size
  corners = board.corners.astype(np.float32)
  _, matrix, distortion, _, _ = cv2.calibrateCamera(
    [corners[x.ids] for x in seen],
    [x.pixels.astype(np.float32) for x in seen],
    (width, height),
    None,
    None,
    flags=cv2.CALIB_FIX_K3,
  )
  fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
  distortion = tuple(map(float, distortion.ravel()[:5]))
  return Lens(height, width, *map(float, (fx, fy, cx, cy)), distortion)
