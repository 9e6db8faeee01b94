"""The runs of the comparison from states: their settings work, budgets are equal."""

from __future__ import annotations

import itertools

import pytest
import state_comparison as comparison

from apnpql_jax.agents.table_one import epsilon_bounds
from apnpql_jax.config.checks import validate
from apnpql_jax.config.files import config_diff

RUNS = [*itertools.product(comparison.TASKS, comparison.ROWS)]


@pytest.mark.parametrize(("task", "row"), RUNS)
def test_settings_of_a_run_are_accepted(task: str, row: str):
  config = comparison.config_of(task, row, 0)
  validate(config, tasks=[task], algorithms=epsilon_bounds())
  assert config.total_steps % config.eval_every == 0


@pytest.mark.parametrize("task", comparison.TASKS)
def test_rows_of_the_paper_differ_in_the_algorithm_and_its_own_settings(task: str):
  """Budget, replay, world and what all share of the agent are the same."""
  first, *others = (comparison.config_of(task, row, 0) for row in comparison.PAPER)
  own = {"algorithm", "epsilon", "policy_initial_std", "min_alpha"}
  for other in others:
    assert config_diff(first, other).keys() <= {f"agent.{name}" for name in own}


def test_the_stored_results_are_read_and_give_the_stored_table():
  found = comparison.results()
  assert len(found) == len(comparison.TASKS) * len(comparison.PAPER) + 2
  assert comparison.table(found) == (comparison.OUT / "table.md").read_text()


def test_the_curves_are_drawn_from_the_stored_results(tmp_path, monkeypatch):
  found = comparison.results()
  monkeypatch.setattr(comparison, "OUT", tmp_path)
  comparison.plot(found)
  assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
