"""Success of a group of runs: the mean over seeds, with an interval."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

from jaxtyping import Float64
import numpy as np

from apnpql_jax.reports.reading import Run
from apnpql_jax.runs.success import interval_of_rate

BANDS = {
  "interval": "95 % interval, the wider of t over seeds and Wilson over all episodes",
  "range": "lowest to highest seed",
}
"""Name of a band -> what it shows."""

AXES = ("steps", "minutes")
"""Abscissas of curves: attributes of a run."""

Points = Float64[np.ndarray, " points"]


class Curve(NamedTuple):
  """Success rates in [0, 1] over steps or minutes."""

  x: Points
  mean: Points
  low: Points
  high: Points


class Interval(NamedTuple):
  """A success rate in [0, 1] and its bounds."""

  mean: float
  low: float
  high: float

  def __str__(self) -> str:
    """Returns such as ``92.5 % (88 to 96)``."""
    return f"{100 * self.mean:.1f} % ({100 * self.low:.0f} to {100 * self.high:.0f})"


def curve(runs: Sequence[Run], axis: str, *, band: str = "interval") -> Curve:
  """Returns the mean of the runs at all points that all of them have reached.

  Runs are evaluated at different times, so their curves are interpolated linearly.

  Args:
    runs: Runs of a group, with at least one evaluation each.
    axis: A name in ``AXES``.
    band: A name in ``BANDS``.
  """
  xs = [np.asarray(getattr(run, axis), float) for run in runs]
  shared = (max(x[0] for x in xs), min(x[-1] for x in xs))
  points: Points = np.unique(np.concatenate(xs))
  points = points[(points >= shared[0]) & (points <= shared[1])]
  rates = np.stack(
    [np.interp(points, x, run.rates) for x, run in zip(xs, runs, strict=True)],
  )
  if band == "range":
    low, high = rates.min(0), rates.max(0)
  else:
    episodes = sum(
      np.interp(points, x, run.episodes) for x, run in zip(xs, runs, strict=True)
    )
    low, high = interval(rates, np.broadcast_to(episodes, points.shape))
  return Curve(points, rates.mean(0), low, high)


def last(runs: Sequence[Run]) -> Interval:
  """Returns the success in ``solved``, with the interval of ``interval``."""
  counts = solved(runs)
  rates = np.array([[rate] for rate, _ in counts])
  low, high = interval(rates, np.array([sum(episodes for _, episodes in counts)]))
  return Interval(float(rates.mean()), float(low[0]), float(high[0]))


def solved(runs: Sequence[Run]) -> list[tuple[float, int]]:
  """Returns the success rate of each run and the number of episodes.

  They are those of the evaluation after training if all runs have one, and otherwise
  those of the last evaluation during training.
  """
  finals = [run.final for run in runs if run.final is not None]
  if len(finals) == len(runs):
    return [(float(x["success_rate"]), int(x["episodes"])) for x in finals]
  return [(run.rates[-1], run.episodes[-1]) for run in runs]


def first_at(run: Run, goal: float, axis: str) -> float | None:
  """Returns steps or minutes of the first evaluation that reaches a success rate."""
  pairs = zip(getattr(run, axis), run.rates, strict=True)
  return next((x for x, rate in pairs if rate >= goal), None)


def interval(
  rates: Float64[np.ndarray, "seeds points"], episodes: Points
) -> tuple[Points, Points]:
  """Returns the outer bounds of two 95 % intervals of the mean over seeds.

  One is the t-interval over seeds. It assumes normally distributed rates and is wide
  for few seeds, but it is a single point if all seeds are equal, such as at 100 %. The
  other is therefore the Wilson interval of all episodes together.

  Args:
    rates: Success rates in [0, 1].
    episodes: Episodes of all seeds together; 0 if unknown.
  """
  mean = rates.mean(0)
  pairs = zip(mean, episodes, strict=True)
  bounds = [interval_of_rate(float(rate), round(number)) for rate, number in pairs]
  low, high = np.reshape(bounds, (-1, 2)).T
  if len(rates) == 1:
    return low, high
  from scipy.special import stdtrit  # Here, because its import slows the start.

  seeds = len(rates)
  half = stdtrit(seeds - 1, 0.975) * rates.std(0, ddof=1) / math.sqrt(seeds)
  return (
    np.minimum(low, np.clip(mean - half, 0.0, 1.0)),
    np.maximum(high, np.clip(mean + half, 0.0, 1.0)),
  )
