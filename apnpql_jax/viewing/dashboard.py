"""The dashboard of the live view: both cameras and the plots, in a narrow column."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math

from matplotlib.artist import Artist
from matplotlib.axes import Axes
import numpy as np

from apnpql_jax.viewing.frame import Frame
from apnpql_jax.viewing.panels import InstantPanel, StripsPanel, place_cameras
from apnpql_jax.viewing.sheet import Sheet, draw_picture

WIDTH = 460
_CAMERAS, _STRIPS, _INSTANT = 190, 470, 170
"""Heights in pixels."""


class Dashboard:
  """Images of both cameras and plots, for an episode in progress."""

  def __init__(self, *, epsilon: float | None, explained: bool, scale: int = 2):
    """Prepares the sheet.

    Args:
      epsilon: Limit of the KL divergence, if any.
      explained: Whether the frames have explanations.
      scale: Factor on the resolution.
    """
    strips, instant = (_STRIPS, _INSTANT) if explained else (110, 0)
    self._pictures: dict[str, Axes] = {}
    self._sheet = sheet = Sheet(WIDTH, _CAMERAS + strips + instant, scale=scale)
    box = (6, _CAMERAS, WIDTH - 14, strips)
    self._strips = StripsPanel(sheet, box, epsilon=epsilon)
    place = (6, _CAMERAS + strips, WIDTH - 14, instant)
    self._instant = InstantPanel(sheet, place) if explained else None

  def draw(self, frames: Sequence[Frame]) -> np.ndarray:
    """Returns the image u8[H, W, 3] of the last of the frames of an episode so far."""
    frame = frames[-1]
    span_s = 5.0 * math.ceil((frame.time_s + frame.period_s) / 5.0 - 1e-6)

    def prepare() -> None:
      self._pictures = place_cameras(self._sheet, (6, 0, WIDTH - 12, _CAMERAS), frame)
      self._strips.prepare(frames, span_s)
      if self._instant:
        self._instant.prepare()

    def paint() -> Iterator[Artist]:
      for name, axis in self._pictures.items():
        yield draw_picture(axis, frame.images[name])
      yield from self._strips.draw(frames)
      if self._instant:
        yield from self._instant.draw(frame)

    return self._sheet.image(self._strips.key(frames, span_s), prepare, paint)
