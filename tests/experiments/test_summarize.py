"""The summary of finished runs that the repository keeps."""

from __future__ import annotations

import csv
import json
import sys

import pytest
from run_files import make_run
import summarize


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
