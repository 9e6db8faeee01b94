"""The four algorithms of the paper on all tasks from states: curves and a table.

  python experiments/results/state_comparison.py --jobs 2            # hours
  python experiments/results/state_comparison.py --tasks push_plate --seeds 0
  python experiments/results/state_comparison.py --tasks push_plate --seeds 0 \
      --rows npql_without_ap sac_without_ap

Trains the runs whose JSON files are missing in state_comparison/ next to this file.
The rows of the paper have equal budgets of environment steps, updates and candidates.
Then plots curves.png and writes table.md from all files there. A run that is
interrupted starts over.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
import itertools
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from summarize import GOAL

from apnpql_jax.cli.options import Train, parse
from apnpql_jax.config.files import (
  config_diff,
  config_from_json,
  format_diff,
  load_preset,
)
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.runs.metrics import read_rows
from apnpql_jax.runs.run_folder import RunFolder, open_run

OUT = Path(__file__).resolve().with_suffix("")


class Row(NamedTuple):
  """An algorithm with its settings."""

  algorithm: str
  flags: str = ""
  """Options that change the preset of the task."""

  budget: int = 1
  """Factor on the environment steps of the other rows."""


# Parametric policies start as narrow as the prior is at its widest.
NARROW = "--agent.policy-initial-std 0.05"
SAC = "--agent.epsilon 10 --agent.min-alpha 0.001"

# Limits and floors by a small search: experiments/log.md, sac1 to sac4.
ROWS = {
  "ap_npql": Row("ap_npql"),
  "ap_mpo": Row("ap_mpo", NARROW),
  # With the presets' floor on alpha, pi never leaves the primitive that it starts at.
  # It starts hundreds of nats from the prior. A limit that binds there would drive
  # alpha to 1,000, and half of the budget would pass before it falls again.
  "ap_sac": Row("ap_sac", f"{NARROW} --agent.epsilon 50 --agent.min-alpha 0.001"),
  # With the uniform prior, 4.85 - epsilon is the floor on the policy's entropy. With
  # the presets' floor on alpha, a nat is worth the discount of one control period.
  "sac": Row("sac", SAC),
  # Without primitives, both as means of the prior and as an auxiliary loss.
  "npql_without_ap": Row(
    "ap_npql",
    "--agent.prior-mean learned --agent.min-std 0.05 --agent.initial-std 0.2 "
    "--agent.max-std 0.3 --agent.lambda-ap 0",
    budget=4,
  ),
  "sac_without_ap": Row("sac", f"{SAC} --agent.lambda-ap 0", budget=4),
}
PAPER = ("ap_npql", "ap_mpo", "ap_sac", "sac")

TASKS = ("push_plate", "stack_box", "flip_cup", "place_plate")

STEPS = 30_720
"""Environment steps per run; four per update."""

EVALUATIONS = 12
"""Evaluations per run, which set the resolution of "steps to 80 %"."""

CANDIDATES = 40
"""Candidates per estimate, fewer than the 120 and 100 of the paper to save hours."""

EPISODES, EPISODES_SEED = 200, 7
"""Episodes and seed of both evaluations after training, sampled and greedy."""

KEPT = ("loss/", "npql/", "prior/", "policy/", "q/", "ap/", "grad_norm/", "faults/")
"""Prefixes of the training metrics that are stored with each evaluation."""

Result = dict[str, Any]


def path_of(task: str, row: str, seed: int) -> Path:
  """Returns the file of a result."""
  return OUT / f"{task}-{row}-{seed}.json"


def options_of(row: str, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  algorithm, flags, budget = ROWS[row]
  options = (
    f"--env.obs state --agent.algorithm {algorithm} --seed {seed} --no-video "
    "--eval-acting policy --agent.candidate-precision float32 "
    f"--total-steps {budget * STEPS} --eval-every {budget * STEPS // EVALUATIONS} "
    f"--agent.target-samples {CANDIDATES} --agent.policy-samples {CANDIDATES} {flags}"
  )
  return options.split()


def config_of(task: str, row: str, seed: int) -> TrainConfig:
  """Returns the settings of a run."""
  base = Train(config=load_preset(task))
  return parse(Train, "train", options_of(row, seed), default=base).config


def train(task: str, row: str, seed: int) -> None:
  """Trains and evaluates a run, and writes its result when all is complete."""
  command, path = ["train", task, *options_of(row, seed)], path_of(task, row, seed)
  with tempfile.TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    apnpql = [sys.executable, "-m", "apnpql_jax"]
    subprocess.run([*apnpql, *command, "--run", str(run)], check=True)
    play = f"--episodes {EPISODES} --seed {EPISODES_SEED} --json".split()
    play = [*apnpql, "evaluate", str(run), *play]
    # "greedy" of the stored results: the highest Q of q, or the mean of a Gaussian.
    non_parametric = ROWS[row].algorithm == "ap_npql"
    final, greedy = (
      json.loads(subprocess.check_output([*play, "--acting", acting]))
      for acting in ("policy", "greedy" if non_parametric else "mean")
    )
    result = {
      "command": command,
      "versions": json.loads((run / "versions.json").read_text()),
      "config": json.loads((run / "config.json").read_text()),
      "final": final,
      "greedy": greedy,
      "evaluations": evaluations(open_run(run)),
    }
  part = path.with_suffix(".part")
  part.write_text(json.dumps(result, indent=1) + "\n")
  os.replace(part, path)
  print(f"{path.stem}: {final['successes']} of {EPISODES}", flush=True)


def evaluations(folder: RunFolder) -> list[dict[str, Any]]:
  """Returns the held-out evaluations, each with the training metrics before it."""
  found, last = [], {}
  for row in read_rows(folder.path / "metrics.jsonl"):
    last |= {name: x for name, x in row.items() if name.startswith(KEPT)}
    if "eval/success_rate" in row:
      names = ("step", "time/wall_s", "eval/success_rate", "eval/episodes")
      found.append({name: row[name] for name in names} | last)
  return found


def results() -> dict[tuple[str, str], list[Result]]:
  """Returns (task, row) -> the stored results, one per seed.

  Raises:
    SystemExit: A result was made with other settings than those of this file.
  """
  found: dict[tuple[str, str], list[Result]] = {}
  for task, row in itertools.product(TASKS, ROWS):
    for path in sorted(OUT.glob(f"{task}-{row}-*.json")):
      result = json.loads(path.read_text())
      was = config_from_json(json.dumps(result["config"]))
      if changed := config_diff(was, config_of(task, row, was.seed)):
        sys.exit(f"{path.name}: {format_diff(changed)}; remove it to train it again")
      found.setdefault((task, row), []).append(result)
  return found


def plot(found: dict[tuple[str, str], list[Result]]) -> None:
  """Plots a panel per task: the mean over seeds, and the range between them."""
  figure, panels = plt.subplots(
    1, len(TASKS), figsize=(3.4 * len(TASKS), 3.2), sharey=True, layout="constrained"
  )
  for panel, task in zip(panels, TASKS, strict=True):
    for color, row in enumerate(PAPER):
      if runs := found.get((task, row)):
        curves = [run["evaluations"] for run in runs]
        rates = 100 * np.array([[x["eval/success_rate"] for x in c] for c in curves])
        steps = [x["step"] / 1000 for x in curves[0]]
        panel.plot(steps, rates.mean(0), ".-", color=f"C{color}", label=row)
        panel.fill_between(
          steps, rates.min(0), rates.max(0), color=f"C{color}", alpha=0.2, linewidth=0
        )
    panel.set(title=task, xlabel="1,000 environment steps")
    panel.set(xlim=(0, STEPS / 1000), ylim=(-2, 102))
  panels[0].set_ylabel("held-out success (%)")
  panels[0].legend()
  figure.savefig(OUT / "curves.png", dpi=120)


def table(found: dict[tuple[str, str], list[Result]]) -> str:
  """Returns a table of the success per seed and the steps to reach the goal."""
  lines = [
    f"| task | row | steps | solved of {EPISODES}, by seed | mean | greedy, by seed "
    f"| first at {100 * GOAL:.0f} % after steps |",
    "|---|---|---|---|---|---|---|",
  ]
  for (task, row), runs in found.items():
    solved, greedy = (
      [run[kind]["successes"] for run in runs] for kind in ("final", "greedy")
    )
    lines.append(
      f"| {task} | {row} | {ROWS[row].budget * STEPS:,} | {_listed(solved)} "
      f"| {100 * np.mean(solved) / EPISODES:.0f} % | {_listed(greedy)} "
      f"| {_listed(map(_steps_to_goal, runs))} |"
    )
  commits = {
    r["versions"]["git"]["commit"][:7] for runs in found.values() for r in runs
  }
  return "\n".join(lines) + f"\n\nMade at commit {_listed(sorted(commits))}.\n"


def _listed(values: Iterable[object]) -> str:
  return ", ".join(map(str, values))


def _steps_to_goal(run: Result) -> str:
  rows = run["evaluations"]
  hits = [row["step"] for row in rows if row["eval/success_rate"] >= GOAL]
  return f"{hits[0]:,.0f}" if hits else f"> {rows[-1]['step']:,.0f}"


def _pool(jobs: int) -> ThreadPoolExecutor:
  """Returns threads that pin their runs to separate cores."""
  cores = sorted(os.sched_getaffinity(0))
  shares = iter([cores[i::jobs] or cores for i in range(jobs)])
  return ThreadPoolExecutor(
    jobs, initializer=lambda: os.sched_setaffinity(0, next(shares))
  )


def main() -> None:
  """Runs the command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
  parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(PAPER))
  parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
  parser.add_argument("--jobs", type=int, default=1, help="runs at once")
  args = parser.parse_args()
  OUT.mkdir(exist_ok=True)
  results()  # Fails before hours of training.
  with _pool(args.jobs) as pool:
    runs = [
      pool.submit(train, task, row, seed)
      for seed, task, row in itertools.product(args.seeds, args.tasks, args.rows)
      if not path_of(task, row, seed).exists()
    ]
  found = results()
  plot(found)
  (OUT / "table.md").write_text(table(found))
  for run in runs:
    run.result()  # Raises the error of a failed run; the others are stored.


if __name__ == "__main__":
  main()
