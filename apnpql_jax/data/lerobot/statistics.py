"""Statistics of columns, by which learners normalize."""

from __future__ import annotations

import numpy as np

QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)

Stats = dict[str, np.ndarray]


def of_numbers(values: np.ndarray) -> Stats:
  """Returns the statistics of numbers or flags [n, k], f64[k] each."""
  values = values.astype(np.float64)
  stats = {
    "min": values.min(0),
    "max": values.max(0),
    "mean": values.mean(0),
    "std": values.std(0),
    "count": np.array([len(values)]),
  }
  for quantile in QUANTILES:
    stats[_name(quantile)] = np.quantile(values, quantile, axis=0)
  return stats


class Pixels:
  """Histogram of the color values in the frames of a video."""

  def __init__(self) -> None:
    self._counts = np.zeros((3, 256), np.int64)
    self._frames = 0

  def add(self, image: np.ndarray) -> None:
    """Adds an image u8[H, W, 3]."""
    self._frames += 1
    for count, values in zip(self._counts, image.reshape(-1, 3).T, strict=True):
      count += np.bincount(values, minlength=256)

  def stats(self) -> Stats:
    """Returns the statistics on a scale of 0 to 1, f64[3, 1, 1] each."""
    levels, total = np.arange(256) / 255, self._counts.sum(1)
    mean = self._counts @ levels / total
    square = self._counts @ levels**2 / total
    below = self._counts.cumsum(1)
    stats = {
      "min": levels[(below > 0).argmax(1)],
      "max": levels[(below == total[:, None]).argmax(1)],
      "mean": mean,
      "std": np.sqrt(np.maximum(square - mean**2, 0.0)),
    }
    for quantile in QUANTILES:
      reached = below >= quantile * total[:, None]
      stats[_name(quantile)] = levels[reached.argmax(1)]
    shaped = {name: value.reshape(3, 1, 1) for name, value in stats.items()}
    return shaped | {"count": np.array([self._frames])}


def combined(a: Stats, b: Stats) -> Stats:
  """Returns the statistics of two parts together; quantiles are weighted means."""
  weights = np.array([a["count"][0], b["count"][0]], np.float64)
  weights /= weights.sum()
  mean = weights[0] * a["mean"] + weights[1] * b["mean"]
  parts = [x["std"] ** 2 + (x["mean"] - mean) ** 2 for x in (a, b)]
  stats = {
    "min": np.minimum(a["min"], b["min"]),
    "max": np.maximum(a["max"], b["max"]),
    "mean": mean,
    "std": np.sqrt(weights[0] * parts[0] + weights[1] * parts[1]),
    "count": a["count"] + b["count"],
  }
  for name in map(_name, QUANTILES):
    stats[name] = weights[0] * a[name] + weights[1] * b[name]
  return stats


def _name(quantile: float) -> str:
  return f"q{round(100 * quantile):02d}"
