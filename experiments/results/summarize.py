"""Curves and a table of finished runs.

  apnpql train push_plate --seed 0 --run runs/a        # then other seeds
  apnpql evaluate runs/a --episodes 200 --seed 7 --json > runs/a/evaluation.json
  python experiments/results/summarize.py OUT runs/a runs/b runs/c

Writes OUT/curves.png and OUT/table.md, as `apnpql plot` and `apnpql compare` do, and
OUT/seed_<n>.csv with the evaluations, to be kept in the repository.
"""

from __future__ import annotations

import csv
from pathlib import Path
import sys

from apnpql_jax.reports import figure, groups, reading, tables
from apnpql_jax.runs.metrics import EPISODES, STEP, SUCCESS, WALL

COLUMNS = (STEP, WALL, SUCCESS, EPISODES)


def main() -> None:
  """Runs the command line: OUT RUN [RUN ...]."""
  out, *paths = map(Path, sys.argv[1:])
  found = groups.group(reading.find(paths))
  runs = [run for group in found for run in group.runs]
  if len({run.config.seed for run in runs}) < len(runs):
    sys.exit("two runs have the same seed; write them to different folders")
  out.mkdir(parents=True, exist_ok=True)
  figure.save(found, out / "curves.png")
  text = tables.markdown(tables.of_runs(found))
  (out / "table.md").write_text(text + "\n")
  for run in runs:
    with (out / f"seed_{run.config.seed}.csv").open("w", newline="") as file:
      table = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
      table.writeheader()
      table.writerows(run.evaluations)
  print(text)


if __name__ == "__main__":
  main()
