"""The summary of finished runs that the repository keeps."""

from __future__ import annotations

import csv
import json
from pathlib import Path
import re
import sys

import pytest
from run_files import make_run
import summarize

from apnpql_jax import testing


def test_curves_table_and_evaluations_of_each_seed_are_written(tmp_path, monkeypatch):
  runs = [make_run(tmp_path / f"run-{i}", [0.2, 0.9], seed=i) for i in (1, 0)]
  final = {"success_rate": 0.95, "episodes": 200, "successes": 190}
  (runs[0] / "evaluation.json").write_text(json.dumps(final))
  out = tmp_path / "results" / "mine"
  monkeypatch.setattr(sys, "argv", ["summarize.py", str(out), *map(str, runs)])
  summarize.main()
  first, second = (out / "table.md").read_text().splitlines()[2:]
  assert first.startswith("| 0 | run-0 | 2.0 | 2.0 | 2,000 | 45 of 50 |")
  assert second.startswith("| 1 | run-1 | 2.0 | 2.0 | 2,000 | 190 of 200 | 95.0 %")
  assert (out / "curves.png").is_file()
  with (out / "seed_1.csv").open() as file:
    rows = list(csv.DictReader(file))
  assert [float(row["eval/success_rate"]) for row in rows] == [0.2, 0.9]
  sys.argv.append(str(make_run(tmp_path / "other", [0.5], seed=1)))
  with pytest.raises(SystemExit, match="two runs have the same seed"):
    summarize.main()


@pytest.mark.parametrize("task", ["push_plate", "stack_box", "place_plate", "flip_cup"])
def test_the_documents_have_the_stored_results(task):
  folder = testing.ROOT / "experiments" / "results" / f"{task}_cpu"
  lines = (folder / "table.md").read_text().splitlines()
  head, _, *rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
  runs = [dict(zip(head, row, strict=True)) for row in rows]
  solved = ", ".join(run["solved"].split()[0] for run in runs) + " of 512"
  minutes = whole([float(run["min"]) for run in runs])
  readme = (testing.ROOT / "README.md").read_text()
  found = re.findall(rf"^\| \[{task}\]\(.+?\) \| (.+) \| (.+) min \|", readme, re.M)
  assert found == [(solved, minutes)]

  page = (testing.ROOT / "docs" / "performance.md").read_text()
  ((to_80, to_95, end),) = re.findall(
    rf"^\| {task}, .+ seeds \| (.+) \| (.+) \| (.+) \|", page, re.M
  )
  assert end == f"{solved} after {minutes}"
  assert numbers(to_80) == [two_digits(float(run["min to 80 %"])) for run in runs]
  curves = [folder / f"seed_{run['seed']}.csv" for run in runs]
  assert numbers(to_95) == [two_digits(minutes_to(0.95, curve)) for curve in curves]


def whole(values: list[float]) -> str:
  return ", ".join(f"{value:.0f}" for value in values)


def numbers(text: str) -> list[float]:
  return [float(value) for value in text.split(", ")]


def two_digits(value: float) -> float:
  return float(f"{value:.2g}")


def minutes_to(rate: float, curve: Path) -> float:
  """Returns the minutes to the first evaluation with at least this success rate."""
  with curve.open() as file:
    rows = csv.DictReader(file)
    good = (row for row in rows if float(row["eval/success_rate"]) >= rate)
    return float(next(good)["time/wall_s"]) / 60
