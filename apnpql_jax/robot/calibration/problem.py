"""Views of a board, and the poses that explain them.

Both cameras obey the same equation. With the flange's pose F in the world at a view,
the board's corner p appears at the pixel

    lens(X^-1 G Y p)

For a camera on the wrist, X is the camera in the flange, Y the board in the world and
G = F^-1. For a fixed camera and a board on the tool, X is the camera in the world, Y
the board in the flange and G = F. For both fixed, G = 1, and Y must be known.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from apnpql_jax.robot.calibration.boards import Board, Seen
from apnpql_jax.robot.calibration.lenses import Lens


@dataclasses.dataclass(frozen=True)
class Problem:
  """Views of a board: their corners, and the G of each."""

  board: Board
  lens: Lens
  seen: list[Seen]
  motion: np.ndarray  # f64[views, 4, 4]

  def select(self, rows: np.ndarray) -> Problem:
    """Returns the problem of some views."""
    seen = [self.seen[i] for i in rows]
    return dataclasses.replace(self, seen=seen, motion=self.motion[rows])

  def errors(self, camera: np.ndarray, board: np.ndarray, scale: float = 1.0) -> list:
    """Returns the errors in pixels of each view, f64[corners, 2]."""
    inverse = np.linalg.inv(camera)
    corners = scale * self.board.corners
    found = []
    for seen, motion in zip(self.seen, self.motion, strict=True):
      pose = inverse @ motion @ board
      points = corners[seen.ids] @ pose[:3, :3].T + pose[:3, 3]
      found.append(self.lens.project(points) - seen.pixels)
    return found

  def error_of_views(self, camera: np.ndarray, board: np.ndarray) -> np.ndarray:
    """Returns the root mean square error of each view in pixels."""
    return np.array([rms(x) for x in self.errors(camera, board)])


def refine(
  problem: Problem,
  camera: np.ndarray,
  board: np.ndarray,
  *,
  fixed: bool = False,
  scaled: bool = False,
  robust: bool = False,
) -> tuple[np.ndarray, np.ndarray, Any]:
  """Minimizes the squared errors in pixels; ``fixed`` keeps the board.

  Returns:
    Both poses and scipy's result, whose x are small changes of the poses (m, rad), then
    the relative change of the board's size if ``scaled``.
  """

  def moved(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    return (
      camera @ _small(x[:6]),
      board if fixed else board @ _small(x[6:12]),
      1.0 + x[-1] if scaled else 1.0,
    )

  def errors(x: np.ndarray) -> np.ndarray:
    return np.concatenate(problem.errors(*moved(x))).ravel()

  found = least_squares(
    errors,
    np.zeros((6 if fixed else 12) + scaled),
    loss="soft_l1" if robust else "linear",
    x_scale="jac",
  )
  camera, board, _ = moved(found.x)
  return camera, board, found


def deviations(found: Any) -> np.ndarray:
  """Returns the standard deviations of the unknowns that scipy solved for."""
  freedom = max(1, len(found.fun) - len(found.x))
  covariance = np.linalg.pinv(found.jac.T @ found.jac) * 2 * found.cost / freedom
  return np.sqrt(np.diag(covariance))


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
  """Returns the angle between the rotations of two poses in degrees."""
  turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3])
  return float(np.degrees(turn.magnitude()))


def rms(errors: np.ndarray) -> float:
  """Returns the root mean square length of errors f64[n, 2]."""
  return float(np.sqrt((errors**2).sum(-1).mean()))


def _small(x: np.ndarray) -> np.ndarray:
  """Returns the pose of a shift (m) and a rotation vector (rad), f64[6]."""
  pose = np.eye(4)
  pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(x[3:]).as_matrix(), x[:3]
  return pose
