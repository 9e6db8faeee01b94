"""Success rates and their confidence intervals."""

from __future__ import annotations

from typing import Any


def success_figures(successes: int, episodes: int) -> dict[str, Any]:
  """Returns what the results of all evaluations hold about their successes."""
  return {
    "successes": successes,
    "success_rate": successes / episodes,
    "ci95": wilson_interval(successes, episodes),
  }


def interval_of_rate(rate: float, episodes: float) -> tuple[float, float]:
  """Returns the 95 % interval of a rate; the rate itself for 0 or unknown episodes."""
  if not episodes:
    return rate, rate
  return wilson_interval(round(rate * episodes), int(episodes))


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
  """Returns the 95 % score interval (Wilson, 1927) of a success rate.

  Unlike the normal approximation, it stays within [0, 1] and does not shrink to a point
  at 0 or ``n`` successes.
  Zero episodes give (0, 1).

  Raises:
    ValueError: ``successes`` is not within [0, n].
  """
  if successes == n == 0:
    return 0.0, 1.0
  from scipy.stats import binomtest  # Here, because its import slows the start.

  low, high = binomtest(successes, n).proportion_ci(method="wilson")
  return float(low), float(high)
