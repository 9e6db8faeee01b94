"""ChArUco boards: chessboards with a marker in each white square."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.robot.vendors import opencv

DICTIONARIES = ("4x4_50", "5x5_100", "6x6_250", "7x7_250")
"""Sets of markers, by modules along a side and number of markers."""

PAPERS = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594)}
"""Name of a paper -> width and height in mm."""

MARGIN_MM = 12.0  # white around the board
FEWEST_CORNERS = 8  # of which a pose is computed
_MODULE_PX = 42  # printed pixels of a module, along each axis
_BORDER = 2  # modules of a marker's black border, both sides together


@dataclasses.dataclass(frozen=True)
class Board:
  """A board; its origin is a corner of the chessboard, z away from the viewer."""

  columns: int = 7
  rows: int = 5
  square_mm: float = 36.0
  marker_mm: float = 27.0
  dictionary: str = "5x5_100"

  def __post_init__(self) -> None:
    """Checks the numbers; raises ``ConfigError``."""
    check_name("dictionary", self.dictionary, DICTIONARIES)
    if not (3 <= self.columns <= 30 and 3 <= self.rows <= 30):
      raise ConfigError(f"a board of {self.columns}x{self.rows} squares; use 3 to 30")
    if not 0 < self.marker_mm < self.square_mm <= 200:
      raise ConfigError(
        f"markers of {self.marker_mm} mm do not fit into squares of {self.square_mm} mm"
      )
    markers, known = self.columns * self.rows // 2, int(self.dictionary.split("_")[1])
    if markers > known:
      raise ConfigError(
        f"the board has {markers} markers, but {self.dictionary} has {known}"
      )

  @property
  def corners(self) -> np.ndarray:
    """Inner corners f64[n, 3] in m, by number."""
    return np.asarray(_charuco(self).getChessboardCorners(), np.float64)

  @property
  def text(self) -> str:
    """The board as ``parse`` reads it."""
    return (
      f"{self.columns}x{self.rows}:{self.square_mm:g}:{self.marker_mm:g}:"
      f"{self.dictionary}"
    )


class Seen(NamedTuple):
  """The corners of a board in an image."""

  ids: np.ndarray  # i64[n]
  pixels: np.ndarray  # f64[n, 2]: x and y; the center of the first pixel is 0, 0


def parse(text: str) -> Board:
  """Returns the board that a text such as 7x5:36:27:5x5_100 describes.

  Columns and rows, side of a square and of a marker in mm, and the dictionary.

  Raises:
    ConfigError: The text does not describe a board.
  """
  number = r"(\d+(?:\.\d+)?)"
  found = re.fullmatch(rf"(\d+)x(\d+):{number}:{number}:(\w+)", text)
  if found is None:
    raise ConfigError(f"{text!r} is no board; write it as {Board().text}")
  columns, rows, square, marker, dictionary = found.groups()
  return Board(int(columns), int(rows), float(square), float(marker), dictionary)


def print_board(board: Board, path: Path) -> dict[str, Any]:
  """Writes the board as .png or .pdf, at true scale on the smallest paper that fits.

  Returns:
    The file, the paper, and what to measure on it.

  Raises:
    ConfigError: The path ends differently, or no paper is large enough.
  """
  from PIL import Image, ImageDraw

  if path.suffix not in (".png", ".pdf"):
    raise ConfigError(f"{path} must end in .png or .pdf")
  size_mm = board.columns * board.square_mm, board.rows * board.square_mm
  fitting = [
    (paper, page)
    for paper, page in PAPERS.items()
    if all(a + 2 * MARGIN_MM <= b for a, b in zip(size_mm, page, strict=True))
  ]
  if not fitting:
    raise ConfigError(
      f"a board of {size_mm[0]:g} x {size_mm[1]:g} mm fits on no paper up to "
      f"{[*PAPERS][-1]}; use fewer or smaller squares"
    )
  paper, page_mm = fitting[0]
  # Whole pixels per module, so that edges are sharp.
  modules = int(board.dictionary[0]) + _BORDER
  px_per_mm = _MODULE_PX * modules / board.marker_mm
  square = round(px_per_mm * board.square_mm)
  px_per_mm = square / board.square_mm
  shape = board.columns * square, board.rows * square
  drawn = _charuco(board).generateImage(shape, marginSize=0)
  page = Image.new("L", [round(px_per_mm * x) for x in page_mm], 255)
  corner = (page.width - shape[0]) // 2, (page.height - shape[1]) // 2
  page.paste(Image.fromarray(drawn), corner)
  label = f"{board.text}   print at 100 %, then measure: {board.columns} squares = "
  label += f"{size_mm[0]:g} mm"
  ImageDraw.Draw(page).text(
    (corner[0], page.height - px_per_mm * 0.75 * MARGIN_MM),
    label,
    fill=0,
    font_size=px_per_mm * 4,
  )
  dpi = 25.4 * px_per_mm
  with replacing(path) as part:
    page.save(part, dpi=(dpi, dpi), resolution=dpi)
  return {
    "file": str(path),
    "paper": paper,
    "board": board.text,
    "measure": f"{board.columns} squares must be {size_mm[0]:g} mm long",
  }


def detect(board: Board, image: np.ndarray) -> Seen | None:
  """Returns the corners in an image u8[H, W, 3], or None if it shows too few."""
  cv2 = opencv()
  gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
  pixels, ids, _, _ = _detector(board).detectBoard(gray)
  if ids is None or len(ids) < FEWEST_CORNERS:
    return None
  ids, pixels = ids.reshape(-1).astype(int), pixels.reshape(-1, 2).astype(np.float64)
  # Corners of one line leave the pose open.
  spread = np.linalg.matrix_rank(np.diff(board.corners[ids, :2], axis=0), tol=1e-6)
  return Seen(ids, pixels) if spread == 2 else None


def other_board(board: Board, image: np.ndarray) -> str | None:
  """Returns what an image shows of another kind of board, or None."""
  cv2 = opencv()
  gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
  for name in (board.dictionary, *DICTIONARIES):
    markers = cv2.aruco.ArucoDetector(_dictionary(name))
    _, ids, _ = markers.detectMarkers(gray)
    if ids is not None and len(ids) >= 4:
      return f"{len(ids)} markers of {name} in another layout or number"
  found, _ = cv2.findChessboardCorners(gray, (board.columns - 1, board.rows - 1))
  return "a chessboard without markers" if found else None


def _dictionary(name: str) -> Any:
  cv2 = opencv()
  return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


@functools.cache
def _charuco(board: Board) -> Any:
  return opencv().aruco.CharucoBoard(
    (board.columns, board.rows),
    board.square_mm / 1e3,
    board.marker_mm / 1e3,
    _dictionary(board.dictionary),
  )


@functools.cache
def _detector(board: Board) -> Any:
  return opencv().aruco.CharucoDetector(_charuco(board))
