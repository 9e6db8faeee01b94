"""The pose of a camera from views of a board; see ``problem`` for the equation."""

from __future__ import annotations

import dataclasses
from typing import Any
import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from apnpql_jax.errors import ConfigError
from apnpql_jax.robot.calibration.problem import (
  Problem,
  angle_deg,
  deviations,
  refine,
  rms,
)

FEWEST_VIEWS = 8
LEAST_TURN_DEG = 10.0
"""How far the flange must turn about a second axis (root mean square over all pairs of
views): turns about a single axis leave the position along it undetermined."""

OUTLIER_MRAD = 3.0  # a view's error above this, seen from the camera, and
OUTLIER_FACTOR = 4.0  # above this many times the median, is an outlier's
MOST_OUTLIERS = 0.4  # share of the views
MOST_MRAD = 10.0  # median error of the views; 4 mm at a distance of 0.4 m
LARGEST_SCALE_ERROR = 0.01  # of the printed board
_FOLDS = 4
_SUBSETS, _SUBSET = 40, 6  # random choices of views for the first guess


@dataclasses.dataclass(frozen=True)
class Solution:
  """The pose of a camera and how well it explains the views."""

  camera: np.ndarray  # X
  board: np.ndarray  # Y
  kept: np.ndarray  # bool[views]: not an outlier
  residuals: dict[str, Any]


def solve(problem: Problem) -> Solution:
  """Returns the poses of camera and board from views at several flange poses.

  Raises:
    ConfigError: There are too few views, they turn too little, most of them contradict
      each other, or the board has another size than it should.
  """
  check_motion(problem)
  poses = np.stack([problem.lens.board_pose(problem.board, x) for x in problem.seen])
  camera, board = _first_guess(problem, poses)
  camera, board, kept = _without_outliers(problem, camera, board)
  good = problem.select(np.flatnonzero(kept))
  check_motion(good)
  _check_scale(good, camera, board)
  residuals = _residuals(good, poses[kept], camera, board)
  residuals |= {"views": int(kept.sum()), "outliers": np.flatnonzero(~kept).tolist()}
  return Solution(camera, board, kept, residuals)


def solve_fixed(problem: Problem, board: np.ndarray) -> Solution:
  """Returns the pose of a fixed camera that sees a board at a known pose.

  Raises:
    ConfigError: There is one view, or the views contradict each other.
  """
  if len(problem.seen) < 2:
    raise ConfigError("one view shows the board, but at least 2 are needed, better 5")
  poses = np.stack([problem.lens.board_pose(problem.board, x) for x in problem.seen])
  guesses = [board @ np.linalg.inv(pose) for pose in poses]
  medians = [np.median(problem.error_of_views(x, board)) for x in guesses]
  camera = guesses[int(np.argmin(medians))]
  camera, board, kept = _without_outliers(problem, camera, board, fixed=True)
  good = problem.select(np.flatnonzero(kept))
  residuals = _residuals(good, poses[kept], camera, board, fixed=True)
  residuals |= {"views": int(kept.sum()), "outliers": np.flatnonzero(~kept).tolist()}
  return Solution(camera, board, kept, residuals)


def check_motion(problem: Problem) -> None:
  """Checks that views suffice for a hand-eye calibration.

  Raises:
    ConfigError: They are too few, or do not turn about two axes.
  """
  count = len(problem.seen)
  if count < FEWEST_VIEWS:
    raise ConfigError(
      f"{count} views show the board, but at least {FEWEST_VIEWS} are needed, better 15"
    )
  turns = Rotation.from_matrix(problem.motion[:, :3, :3])
  pairs = [(turns[i].inv() * turns[i + 1 :]).as_rotvec() for i in range(count - 1)]
  vectors = np.concatenate(pairs)
  moments = np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))
  first, second = np.degrees(np.sqrt(np.maximum(moments[::-1][:2], 0.0)))
  if second < LEAST_TURN_DEG:
    raise ConfigError(
      f"the flange turns {first:.1f} degrees about one axis and {second:.1f} about a "
      f"second, of which at least {LEAST_TURN_DEG:.0f} are needed: tilt it in two "
      "directions and turn it between views"
    )


def hand_eye(hands: np.ndarray, poses: np.ndarray) -> np.ndarray:
  """Returns the X that makes H_i X P_i the same in all views i.

  For two views, that is A X = X B with A = H_j^-1 H_i and B = P_j P_i^-1, solved in
  closed form for all pairs: F. C. Park and B. J. Martin, "Robot sensor calibration:
  solving AX = XB on the Euclidean group", 1994.

  Args:
    hands: H, f64[views, 4, 4].
    poses: P, f64[views, 4, 4].
  """
  i, j = np.triu_indices(len(hands), 1)
  a, b = np.linalg.inv(hands[j]) @ hands[i], poses[j] @ np.linalg.inv(poses[i])
  turns = (Rotation.from_matrix(x[:, :3, :3]).as_rotvec() for x in (a, b))
  camera = np.eye(4)
  with warnings.catch_warnings(action="ignore"):  # Of views about a single axis.
    camera[:3, :3] = Rotation.align_vectors(*turns)[0].as_matrix()
  rows = np.eye(3) - a[:, :3, :3]
  shifts = a[:, :3, 3] - b[:, :3, 3] @ camera[:3, :3].T
  camera[:3, 3] = np.linalg.lstsq(rows.reshape(-1, 3), shifts.reshape(-1))[0]
  return camera


def _first_guess(problem: Problem, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the X and Y with the least median error.

  They are solved from all views, and from random choices, of which some have no
  outliers.
  """
  rng, count = np.random.default_rng(0), len(poses)
  subsets = [np.arange(count)]
  subsets += [rng.permutation(count)[:_SUBSET] for _ in range(_SUBSETS)]
  hands = np.linalg.inv(problem.motion)
  guesses = []
  for rows in subsets:
    camera = hand_eye(hands[rows], poses[rows])
    guesses.append((camera, _mean_pose(hands[rows] @ camera @ poses[rows])))
  return min(guesses, key=lambda x: np.median(problem.error_of_views(*x)))


def _without_outliers(
  problem: Problem, camera: np.ndarray, board: np.ndarray, *, fixed: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Refines the poses, leaves out views that contradict them, and refines again."""
  px_per_mrad = problem.lens.fx / 1e3
  kept = np.ones(len(problem.seen), bool)
  camera, board, _ = refine(problem, camera, board, fixed=fixed, robust=True)
  for _ in range(5):
    error = problem.error_of_views(camera, board)
    limit = max(OUTLIER_MRAD * px_per_mrad, OUTLIER_FACTOR * float(np.median(error)))
    before, kept = kept, error < limit
    if len(kept) - kept.sum() > MOST_OUTLIERS * len(kept):
      break
    good = problem.select(np.flatnonzero(kept))
    camera, board, _ = refine(good, camera, board, fixed=fixed)
    if (kept == before).all():
      break
  median = float(np.median(problem.error_of_views(camera, board)))
  if median > MOST_MRAD * px_per_mrad or (~kept).mean() > MOST_OUTLIERS:
    raise ConfigError(
      f"the views contradict each other by {median:.1f} pixels (median): check that "
      "the board did not move, that joint angles belong to their images and are in "
      "rad, and that the board is the one named"
    )
  return camera, board, kept


def _check_scale(problem: Problem, camera: np.ndarray, board: np.ndarray) -> None:
  """Checks the size of the board against the motion of the arm."""
  _, _, found = refine(problem, camera, board, scaled=True)
  scale, deviation = 1.0 + found.x[-1], deviations(found)[-1]
  if abs(scale - 1.0) > max(LARGEST_SCALE_ERROR, 3 * deviation):
    raise ConfigError(
      f"by the motion of the arm, the board's squares measure "
      f"{scale * problem.board.square_mm:.2f} mm, not {problem.board.square_mm:g}: "
      "measure the print, and name its size or print it at 100 %"
    )


def _residuals(
  problem: Problem,
  poses: np.ndarray,
  camera: np.ndarray,
  board: np.ndarray,
  *,
  fixed: bool = False,
) -> dict[str, Any]:
  """Returns errors on all views, on views that were held out, and uncertainties."""
  _, _, found = refine(problem, camera, board, fixed=fixed)
  deviation = deviations(found)
  rows = np.arange(len(poses))
  folds = min(_FOLDS, len(poses))
  held_out = []
  for fold in range(folds):
    test = rows % folds == fold
    cameras = refine(problem.select(rows[~test]), camera, board, fixed=fixed)[:2]
    held_out.append(_consistency(problem.select(rows[test]), poses[test], *cameras))
  return _consistency(problem, poses, camera, board) | {
    "held_out": {
      name: float(np.sqrt(np.mean([x[name] ** 2 for x in held_out])))
      for name in held_out[0]
    },
    "deviation_mm": float(1e3 * np.linalg.norm(deviation[:3])),
    "deviation_deg": float(np.degrees(np.linalg.norm(deviation[3:6]))),
  }


def _consistency(
  problem: Problem, poses: np.ndarray, camera: np.ndarray, board: np.ndarray
) -> dict[str, Any]:
  """Returns root mean squares of errors: pixels, and the board's pose in the camera."""
  expected = np.linalg.inv(camera) @ problem.motion @ board
  shift = np.linalg.norm(expected[:, :3, 3] - poses[:, :3, 3], axis=1)
  turn = [angle_deg(a, b) for a, b in zip(expected, poses, strict=True)]
  return {
    "px": rms(np.concatenate(problem.errors(camera, board))),
    "mm": 1e3 * float(np.sqrt(np.mean(shift**2))),
    "deg": float(np.sqrt(np.mean(np.square(turn)))),
  }


def _mean_pose(poses: np.ndarray) -> np.ndarray:
  """Returns the median position and the mean rotation of poses."""
  pose = np.eye(4)
  pose[:3, :3] = Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix()
  pose[:3, 3] = np.median(poses[:, :3, 3], axis=0)
  return pose
