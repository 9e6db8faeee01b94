"""Encoding of the images of an episode."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from apnpql_jax.data.lerobot.statistics import Pixels


class Video:
  """A video that is being written."""

  def __init__(self, path: Path, size: tuple[int, int], fps: float):
    self.pixels = Pixels()
    self._path = path
    self._file = av.open(str(path), "w", format="mp4")
    self._stream = self._file.add_stream(
      "libx264", Fraction(fps).limit_denominator(1000)
    )
    # Full color, for small images of odd sizes too; a key frame every other frame, so
    # that any frame is soon read.
    self._stream.height, self._stream.width = size
    self._stream.pix_fmt = "yuv444p"
    self._stream.options = {"crf": "10", "g": "2", "bf": "0", "preset": "veryfast"}

  def add(self, image: np.ndarray) -> None:
    """Adds u8[H, W, 3]."""
    self.pixels.add(image)
    self._file.mux(self._stream.encode(av.VideoFrame.from_ndarray(image)))

  def finish(self, path: Path) -> None:
    """Completes the file and gives it its name."""
    self._file.mux(self._stream.encode())
    self._file.close()
    self._path.replace(path)

  def discard(self) -> None:
    """Removes the file."""
    self._file.close()
    self._path.unlink(missing_ok=True)
