"""Curves and a table of finished runs.

  apnpql train push_plate --seed 0 --run runs/a        # then other seeds
  apnpql evaluate runs/a --episodes 200 --seed 7 --json > runs/a/evaluation.json
  python experiments/results/summarize.py OUT runs/a runs/b runs/c

Writes OUT/curves.png, OUT/table.md and OUT/seed_<n>.csv (the evaluations).
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from apnpql_jax.runs.metrics import read_evaluations
from apnpql_jax.runs.run_folder import RunFolder, open_run

COLUMNS = ("step", "time/wall_s", "eval/success_rate", "eval/episodes")
GOAL = 0.8


def evaluations(folder: RunFolder) -> list[dict[str, float]]:
  """Returns step, seconds, rate and number of episodes of each held-out evaluation."""
  rows = read_evaluations(folder.path)
  return [{name: row[name] or 0.0 for name in COLUMNS} for row in rows]


def table_row(folder: RunFolder) -> str:
  """Returns a row: seed, minutes to the goal, minutes, steps, success, interval."""
  rows = evaluations(folder)
  result = json.loads((folder.path / "evaluation.json").read_text())
  reached = [r for r in rows if r["eval/success_rate"] >= GOAL]
  minutes = f"{reached[0]['time/wall_s'] / 60:.1f}" if reached else "not reached"
  low, high = result["ci95"]
  return (
    f"| {folder.config.seed} | {minutes} | {rows[-1]['time/wall_s'] / 60:.1f} "
    f"| {rows[-1]['step']:,.0f} | {result['successes']} of {result['episodes']} "
    f"| {100 * result['success_rate']:.1f} % ({100 * low:.1f} to {100 * high:.1f}) |"
  )


def plot(folders: list[RunFolder], path: Path) -> None:
  """Plots the success rate over minutes of wall clock, one line per run."""
  figure, axes = plt.subplots(figsize=(6, 3.6), layout="constrained")
  for folder in folders:
    rows = evaluations(folder)
    minutes = [row["time/wall_s"] / 60 for row in rows]
    rates = [100 * row["eval/success_rate"] for row in rows]
    axes.plot(minutes, rates, "o-", label=f"seed {folder.config.seed}")
  axes.axhline(100 * GOAL, color="gray", linestyle=":")
  axes.set(xlabel="wall clock (min)", ylabel="held-out success (%)", ylim=(-2, 102))
  axes.set_title(folders[0].config.env.task)
  axes.legend()
  figure.savefig(path, dpi=120)


def main() -> None:
  """Runs the command line: OUT RUN [RUN ...]."""
  out, *runs = map(Path, sys.argv[1:])
  folders = sorted(map(open_run, runs), key=lambda folder: folder.config.seed)
  out.mkdir(parents=True, exist_ok=True)
  plot(folders, out / "curves.png")
  head = (
    f"| seed | min to {100 * GOAL:.0f} % | min | env steps | solved | rate (95 %) |",
    "|---|---|---|---|---|---|",
  )
  lines = [*head, *map(table_row, folders)]
  (out / "table.md").write_text("\n".join(lines) + "\n")
  for folder in folders:
    with (out / f"seed_{folder.config.seed}.csv").open("w", newline="") as file:
      table = csv.DictWriter(file, COLUMNS)
      table.writeheader()
      table.writerows(evaluations(folder))
  print("\n".join(lines))


if __name__ == "__main__":
  main()
