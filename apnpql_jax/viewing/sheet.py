"""A figure that redraws only what has changed since the previous frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np

_DPI = 100


class Sheet:
  """A white page with axes at places in pixels.

  Drawing axes with their ticks and titles takes most of the time of a figure. They are
  drawn once, and again when what they depend on has changed.
  """

  def __init__(self, width: int, height: int, *, scale: int = 1):
    """Takes the size in pixels, each of which is drawn as ``scale`` x ``scale``."""
    self.width, self.height = width, height
    inches = width / _DPI, height / _DPI
    self.figure = Figure(figsize=inches, dpi=_DPI * scale, facecolor="white")
    self._canvas = FigureCanvasAgg(self.figure)
    self._key: Any = None
    self._background: Any = None

  def place(self, left: float, top: float, width: float, height: float) -> Axes:
    """Returns new axes at a place in pixels from the upper left corner."""
    bottom = self.height - top - height
    across, up = 1 / self.width, 1 / self.height
    return self.figure.add_axes(
      (left * across, bottom * up, width * across, height * up)
    )

  def picture(self, *place: float) -> Axes:
    """Returns axes for ``draw_picture`` at a place, with pixels as coordinates."""
    axis = self.place(*place)
    axis.set(xlim=(0, place[2]), ylim=(place[3], 0))
    axis.set_axis_off()
    return axis

  def image(
    self,
    key: Any,
    prepare: Callable[[], None],
    draw: Callable[[], Iterable[Artist]],
  ) -> np.ndarray:
    """Returns the page as u8[H, W, 3].

    Args:
      key: What the axes depend on. If it differs from the last key, ``prepare`` makes
        the axes again.
      prepare: Makes the axes.
      draw: Adds what changes with every frame.
    """
    if key != self._key:
      self.figure.clear()
      prepare()
      self._canvas.draw()
      self._background = self._canvas.copy_from_bbox(self.figure.bbox)
      self._key = key
    self._canvas.restore_region(self._background)
    for artist in list(draw()):
      self.figure.draw_artist(artist)
      artist.remove()
    return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def draw_picture(
  axis: Axes, image: np.ndarray, extent: tuple[float, float, float, float] | None = None
) -> Artist:
  """Draws an image u8[H, W, 3] in axes of ``Sheet.picture``.

  ``extent`` is its left, right, bottom and top; by default it fills the axes.
  """
  extent = extent or (*axis.get_xlim(), *axis.get_ylim())
  return axis.imshow(image, interpolation="nearest", aspect="auto", extent=extent)
