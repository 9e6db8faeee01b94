"""Plots of what an agent considers over the time of an episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
import numpy as np

from apnpql_jax.types import PRIMITIVES
from apnpql_jax.viewing.frame import COLORS, Frame

INK, FAINT, GRID = "#343a40", "#868e96", "#dee2e6"
RGB = np.array([to_rgb(color) for color in COLORS])

Frames = Sequence[Frame]


class Strip(NamedTuple):
  """A plot over time."""

  title: str
  height: float  # relative to the others
  limits: Callable[[Frames], tuple[float, float]]
  draw: Callable[[Axes, Frames], list[Artist]]
  limit: bool = False  # whether the KL limit is drawn


def strips_of(frame: Frame) -> list[Strip]:
  """Returns the plots that can be drawn of an episode, from top to bottom."""
  if frame.explanation is None:
    return [_EXPERT]
  return [_PRIOR, _TILTED, _STAGE, *_FIGURES] if frame.guided else [_EXPERT, *_FIGURES]


def prepare(
  axis: Axes,
  strip: Strip,
  limits: tuple[float, float],
  *,
  span_s: float,
  bottom: bool,
  epsilon: float | None,
) -> None:
  """Prepares the axes of a strip.

  Args:
    axis: Empty axes.
    strip: What they will show.
    limits: Lowest and highest value.
    span_s: The time that is shown, s.
    bottom: Whether the time is labeled.
    epsilon: The limit of the KL divergence, if any.
  """
  axis.set(xlim=(0, span_s), ylim=limits)
  if strip in (_PRIOR, _TILTED):
    axis.set_yticks([0, 1])
  elif strip in (_STAGE, _EXPERT):
    names = ["expert", "chosen"] if strip is _STAGE else ["expert"]
    axis.set_yticks(np.arange(len(names)) + 0.5, names)
  else:
    axis.locator_params(axis="y", nbins=3)
  plain(axis)
  axis.tick_params(labelbottom=bottom)
  if bottom:
    axis.set_xlabel("time in s", fontsize=7, color=FAINT, labelpad=1)
  if strip.limit and epsilon is not None:
    axis.axhline(epsilon, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
  title(axis, strip.title)


def legend(axis: Axes) -> None:
  """Names the colors of the primitives above the right end of the axes."""
  place: dict[str, Any] = {"ha": "right", "va": "bottom", "xycoords": "axes fraction"}
  style: dict[str, Any] = {"fontsize": 8, "fontweight": "bold"}
  place["textcoords"] = "offset points"
  for name, color, left in zip(PRIMITIVES, COLORS, (92, 56, 0), strict=True):
    offset = (-left, 3)
    axis.annotate(f"■ {name}", (1, 1), offset, color=color, **place, **style)


def plain(axis: Axes) -> None:
  """Leaves nothing of the axes but faint lines and labels."""
  axis.tick_params(labelsize=7, length=0, colors=FAINT)
  for spine in axis.spines.values():
    spine.set_visible(False)
  axis.grid(color=GRID, linewidth=0.6)
  axis.set_axisbelow(True)


def title(axis: Axes, text: str) -> None:
  """Writes a line above the left end of the axes."""
  axis.set_title(text, loc="left", fontsize=8, color=INK, pad=3)


def palette(frame: Frame) -> np.ndarray:
  """Returns the colors of the prior's components, f64[k, 3]."""
  prior = frame.explanation.prior if frame.explanation else None
  count = 1 if prior is None else len(prior.shares)
  return RGB if count == len(RGB) else np.tile(to_rgb(FAINT), (count, 1))


def candidate_colors(frame: Frame) -> np.ndarray:
  """Returns the colors of the candidates, f64[S, 3]: those of their components."""
  thought: Any = frame.explanation
  if thought.prior is None:
    return np.repeat(palette(frame), len(thought.weights), axis=0)
  return palette(frame)[thought.prior.candidates]


def _edges(frames: Frames) -> np.ndarray:
  """Returns where the control periods of the instants begin and end, f64[n + 1], s."""
  t = np.array([frame.time_s for frame in frames])
  return np.append(t, t[-1] + frames[0].period_s)


def _stacked(axis: Axes, frames: Frames, shares: np.ndarray) -> list[Artist]:
  top = np.cumsum(shares, axis=1)
  below = np.concatenate([np.zeros((len(top), 1)), top[:, :-1]], axis=1)
  return [
    axis.stairs(high, _edges(frames), baseline=low, fill=True, color=color, alpha=0.85)
    for high, low, color in zip(top.T, below.T, COLORS, strict=True)
  ]


def _prior(axis: Axes, frames: Frames) -> list[Artist]:
  return _stacked(axis, frames, np.array([frame.shares for frame in frames]))


def _tilted(axis: Axes, frames: Frames) -> list[Artist]:
  """Draws the weights of the candidates of each component after the Boltzmann step."""
  thoughts: list[Any] = [frame.explanation for frame in frames]
  every = np.arange(len(PRIMITIVES))
  shares = [x.weights @ (x.prior.candidates[:, None] == every) for x in thoughts]
  return _stacked(axis, frames, np.array(shares))


def _stage(axis: Axes, frames: Frames) -> list[Artist]:
  """Draws the component of the action above the primitive of the expert."""
  thoughts: list[Any] = [frame.explanation for frame in frames]
  colors = [RGB[x.prior.chosen] for x in thoughts]
  return [*_expert(axis, frames), *_cells(axis, frames, colors, row=1)]


def _expert(axis: Axes, frames: Frames) -> list[Artist]:
  return _cells(axis, frames, [RGB[frame.stage] for frame in frames], row=0)


def _cells(axis: Axes, frames: Frames, colors: Any, *, row: int) -> list[Artist]:
  edges = _edges(frames)
  x, widths = edges[:-1], 0.94 * np.diff(edges)
  return [*axis.bar(x, 0.86, widths, row + 0.07, align="edge", color=colors)]


def _q(axis: Axes, frames: Frames) -> list[Artist]:
  """Draws Q of all candidates, larger with their weights, and of the action."""
  thoughts: list[Any] = [frame.explanation for frame in frames]
  t = np.array([frame.time_s for frame in frames])
  share = np.concatenate([x.weights / x.weights.max() for x in thoughts])
  q = np.array([x.q_values for x in thoughts])
  colors = np.concatenate([candidate_colors(frame) for frame in frames])
  style: dict[str, Any] = {"s": 2 + 10 * share, "c": colors, "alpha": 0.35}
  dots = axis.scatter(np.repeat(t, q.shape[1]), q.ravel(), linewidths=0, **style)
  action = [float(x.action_q) for x in thoughts]
  return [dots, *axis.plot(t, action, color=INK, linewidth=1.2)]


def _q_limits(frames: Frames) -> tuple[float, float]:
  q = np.concatenate([x.explanation.q_values for x in frames])  # ty: ignore
  low, high = np.floor(10 * q.min()) / 10, np.ceil(10 * q.max()) / 10
  return float(low), float(max(high, low + 0.1))


def _line(name: str) -> Callable[[Axes, Frames], list[Artist]]:
  def draw(axis: Axes, frames: Frames) -> list[Artist]:
    t = [frame.time_s for frame in frames]
    y = [float(getattr(frame.explanation, name)) for frame in frames]
    return [*axis.plot(t, y, color=INK, linewidth=1.4)]

  return draw


def _up_to(name: str, least: float) -> Callable[[Frames], tuple[float, float]]:
  """Returns limits from zero to a power of two times ``least``."""

  def limits(frames: Frames) -> tuple[float, float]:
    highest = max(float(getattr(frame.explanation, name)) for frame in frames)
    return 0.0, least * 2.0 ** max(0, int(np.ceil(np.log2(max(highest, 1e-9) / least))))

  return limits


def _fixed(high: float) -> Callable[[Frames], tuple[float, float]]:
  return lambda frames: (0.0, high)


_PRIOR = Strip("prior: weights of the primitives", 1.2, _fixed(1), _prior)
_TILTED = Strip("policy: after the Boltzmann step exp(Q / α)", 1.2, _fixed(1), _tilted)
_STAGE = Strip("primitive of the action, and of the expert", 0.5, _fixed(2), _stage)
_EXPERT = Strip("primitive that the expert would follow", 0.3, _fixed(1), _expert)
_FIGURES = [
  Strip("Q: candidates •, action ―", 1.4, _q_limits, _q),
  Strip(
    "KL of policy and prior, nats; its limit dashed",
    0.7,
    _up_to("kl", 1.2),
    _line("kl"),
    limit=True,
  ),
  Strip(
    "effective number of candidates", 0.7, lambda f: (0.0, _count(f)), _line("ess")
  ),
  Strip("temperature α", 0.7, _up_to("alpha", 0.02), _line("alpha")),
]


def _count(frames: Frames) -> float:
  return float(len(frames[0].explanation.weights))  # ty: ignore
