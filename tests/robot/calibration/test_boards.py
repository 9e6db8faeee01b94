"""Boards: as printed, and as read."""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image
import pytest

pytest.importorskip("cv2")

from apnpql_jax.errors import ConfigError, DeviceError
from apnpql_jax.robot.calibration import boards
from apnpql_jax.robot.calibration.boards import Board


@pytest.mark.parametrize(
  ("board", "paper"),
  [
    (Board(), "A4"),
    (Board(11, 8, 33.5, 25.0, "6x6_250"), "A3"),
    (Board(6, 4, 20.0, 15.0, "4x4_50"), "A4"),
  ],
)
def test_a_print_is_at_true_scale(tmp_path, board, paper):
  path = tmp_path / "board.png"
  about = boards.print_board(board, path)
  assert about["paper"] == paper
  with Image.open(path) as image:
    pixels_per_mm = np.array(image.info["dpi"]) / 25.4
    page_mm = np.array(image.size) / pixels_per_mm
    np.testing.assert_allclose(page_mm, boards.PAPERS[paper], atol=0.2)
    seen = boards.detect(board, np.asarray(image.convert("RGB")))
  assert seen is not None and len(seen.ids) == len(board.corners)
  corners = 1e3 * board.corners[seen.ids, :2]
  found = seen.pixels / pixels_per_mm
  for i in (0, len(found) // 2):
    np.testing.assert_allclose(found - found[i], corners - corners[i], atol=0.05)


def test_a_print_may_be_a_pdf_of_the_same_size(tmp_path):
  path = tmp_path / "board.pdf"
  boards.print_board(Board(), path)
  data = path.read_bytes()
  assert data.startswith(b"%PDF")
  box = data.split(b"/MediaBox")[1].split(b"[")[1].split(b"]")[0]
  points = np.array([float(x) for x in box.split()])[2:]
  np.testing.assert_allclose(points / 72 * 25.4, boards.PAPERS["A4"], atol=0.2)


def test_a_board_is_its_text():
  for board in (Board(), Board(11, 8, 33.5, 25.0, "6x6_250")):
    assert boards.parse(board.text) == board


@pytest.mark.parametrize(
  ("text", "match"),
  [
    ("7x5", "write it as 7x5:36:27:5x5_100"),
    ("7x5:36:27:9x9_9", "unknown dictionary '9x9_9'"),
    ("2x5:36:27:5x5_100", "use 3 to 30"),
    ("7x5:27:36:5x5_100", "do not fit into squares"),
    ("20x20:10:7:5x5_100", "has 200 markers, but 5x5_100 has 100"),
  ],
)
def test_texts_that_are_no_board_are_refused(text, match):
  with pytest.raises(ConfigError, match=match):
    boards.parse(text)


def test_prints_that_cannot_be_are_refused(tmp_path):
  with pytest.raises(ConfigError, match=r"must end in .png or .pdf"):
    boards.print_board(Board(), tmp_path / "board.jpg")
  with pytest.raises(ConfigError, match="fits on no paper up to A1"):
    boards.print_board(Board(20, 9, 60.0, 45.0), tmp_path / "board.png")


def test_a_missing_package_is_one_line(monkeypatch):
  monkeypatch.setitem(sys.modules, "cv2", None)
  with pytest.raises(DeviceError, match="robot needs opencv-contrib-python-headless"):
    boards.detect(Board(), np.zeros((9, 9, 3), np.uint8))


def test_an_opencv_without_the_boards_is_one_line(monkeypatch):
  monkeypatch.delattr(pytest.importorskip("cv2"), "aruco")
  with pytest.raises(DeviceError, match=r">=4.11, .* lacks cv2.aruco"):
    boards.detect(Board(), np.zeros((9, 9, 3), np.uint8))
