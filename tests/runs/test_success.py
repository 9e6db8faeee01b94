"""Success rates and their intervals, against published ones and scipy's."""

from __future__ import annotations

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from scipy import stats

from apnpql_jax.runs import success


@pytest.mark.parametrize(
  ("successes", "n", "low", "high"),
  [
    (81, 263, 0.2553, 0.3662),
    (15, 148, 0.0624, 0.1605),
    (0, 20, 0.0, 0.1611),
    (1, 29, 0.0061, 0.1718),
  ],
)
def test_wilson_interval_equals_the_published_one(successes, n, low, high):
  """Newcombe (1998), Statistics in Medicine 17, table I, method 3."""
  got = success.wilson_interval(successes, n)
  np.testing.assert_allclose(got, (low, high), atol=5e-5)


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_covers_the_rate(pair: tuple[int, int]):
  successes, n = pair
  low, high = success.wilson_interval(successes, n)
  assert 0.0 <= low <= successes / n <= high <= 1.0 and low < high


def test_wilson_interval_needs_successes_within_the_episodes():
  assert success.wilson_interval(0, 0) == (0.0, 1.0)
  for successes, n in ((-1, 5), (6, 5), (1, 0)):
    with pytest.raises(ValueError, match="must"):
      success.wilson_interval(successes, n)


def test_the_interval_of_a_rate_needs_the_number_of_episodes():
  expected = stats.binomtest(34, 40).proportion_ci(method="wilson")
  found = success.interval_of_rate(0.85, 40)
  np.testing.assert_allclose(found, expected, rtol=1e-9)
  assert success.interval_of_rate(0.85, 0) == (0.85, 0.85)


def test_figures_are_the_counts_with_their_interval():
  low, high = success.wilson_interval(3, 4)
  expected = {"successes": 3, "success_rate": 0.75, "ci95": (low, high)}
  assert success.success_figures(3, 4) == expected
