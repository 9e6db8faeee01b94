"""Panels of a sheet: both cameras, the strips over time, and the present instant."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
import numpy as np

from apnpql_jax.types import ARM_DOF
from apnpql_jax.viewing import strips
from apnpql_jax.viewing.frame import Frame
from apnpql_jax.viewing.sheet import Sheet
from apnpql_jax.viewing.strips import INK, Frames

Box = tuple[float, float, float, float]
"""Left, top, width and height in pixels."""

_GAP = 21
_MOST = 92.0
"""Greatest height in pixels of a strip of height one."""


def place_cameras(sheet: Sheet, box: Box, frame: Frame) -> dict[str, Axes]:
  """Makes axes for the images of both cameras, side by side in a box of a sheet."""
  left, top, width, height = box
  axes, room = {}, (width - 12) / 2
  for name, text in ("global", "camera over the table"), ("wrist", "on the wrist"):
    high, across = frame.images[name].shape[:2]
    factor = min((height - 18) / high, room / across)
    axes[name] = sheet.picture(left, top + 18, across * factor, high * factor)
    strips.title(axes[name], text)
    left += room + 12
  return axes


class StripsPanel:
  """Strips over time, one above the other in a box of a sheet."""

  def __init__(self, sheet: Sheet, box: Box, *, epsilon: float | None):
    """Keeps the place; ``epsilon`` is the limit of the KL divergence, if any."""
    self._sheet, self._box, self._epsilon = sheet, box, epsilon
    self._axes: list[tuple[strips.Strip, Axes]] = []

  def key(self, frames: Frames, span_s: float) -> Any:
    """Returns what the axes depend on; ``frames`` set the limits of their values."""
    every = strips.strips_of(frames[0])
    return span_s, tuple((strip.title, strip.limits(frames)) for strip in every)

  def prepare(self, frames: Frames, span_s: float) -> None:
    """Makes the axes for ``frames``, over ``span_s`` seconds."""
    every = strips.strips_of(frames[0])
    left, top, width, height = self._box
    room = height - 46 - _GAP * (len(every) - 1)
    unit = min(room / sum(strip.height for strip in every), _MOST)
    self._axes, top = [], top + 18
    for strip in every:
      axis = self._sheet.place(left + 34, top, width - 34, strip.height * unit)
      strips.prepare(
        axis,
        strip,
        strip.limits(frames),
        span_s=span_s,
        bottom=strip is every[-1],
        epsilon=self._epsilon,
      )
      self._axes.append((strip, axis))
      top += strip.height * unit + _GAP
    strips.legend(self._axes[0][1])

  def draw(self, frames: Frames) -> Iterator[Artist]:
    """Adds the frames up to the last, where a line marks the time."""
    for strip, axis in self._axes:
      yield from strip.draw(axis, frames)
      yield axis.axvline(frames[-1].time_s, color=INK, linewidth=0.8, alpha=0.5)


class InstantPanel:
  """Joint velocities of candidates, means and action at an instant, in a box."""

  def __init__(self, sheet: Sheet, box: Box):
    """Keeps the place."""
    self._sheet, self._box = sheet, box

  def prepare(self) -> None:
    """Makes the axes."""
    left, top, width, height = self._box
    axis = self._sheet.place(left + 22, top + 18, width - 22, height - 34)
    axis.set(xlim=(-0.5, ARM_DOF + 0.5), ylim=(-1.15, 1.15), yticks=[-1, 0, 1])
    names = [*(f"j{i}" for i in range(1, ARM_DOF + 1)), "grip"]
    axis.set_xticks(range(ARM_DOF + 1), names)
    strips.plain(axis)
    axis.grid(visible=False, axis="x")
    strips.title(axis, "now, rad/s: ◆ action  • candidates  ▬ means of the prior")
    self._axis = axis

  def draw(self, frame: Frame) -> Iterator[Artist]:
    """Adds a frame; the gripper's command is from -1, open, to 1, closed."""
    axis, x = self._axis, np.arange(ARM_DOF + 1)
    explanation: Any = frame.explanation
    if explanation is not None:
      weights = np.sqrt(explanation.weights / explanation.weights.max())
      spread = np.linspace(-0.16, 0.16, len(weights))[:, None]
      repeat: Any = {"repeats": ARM_DOF + 1, "axis": 0}
      yield axis.scatter(
        (x + spread).ravel(),
        _signed(explanation.candidates).ravel(),
        s=np.repeat(np.maximum(30 * weights, 3), **repeat),
        c=np.repeat(strips.candidate_colors(frame), **repeat),
        alpha=0.35,
        linewidths=0,
      )
      if (prior := explanation.prior) is not None:
        parts = prior.means, prior.shares, strips.palette(frame)
        for mean, share, color in zip(*parts, strict=True):
          style: Any = {"color": color, "linewidth": 1.2 + 3 * float(share)}
          yield axis.hlines(_signed(mean), x - 0.32, x + 0.32, **style)
    yield from axis.plot(x, _signed(frame.action), "D", color=INK, markersize=4.5)


def _signed(actions: np.ndarray) -> np.ndarray:
  """Returns actions with a gripper command from -1 to 1 instead of 0 to 1."""
  return np.concatenate([actions[..., :ARM_DOF], 2 * actions[..., ARM_DOF:] - 1], -1)
