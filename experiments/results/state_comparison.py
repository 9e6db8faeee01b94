"""The four algorithms of the paper on all tasks from states: curves and a table.

  python experiments/results/state_comparison.py --jobs 2            # hours
  python experiments/results/state_comparison.py --tasks push_plate --seeds 0
  python experiments/results/state_comparison.py --tasks push_plate --seeds 0 \
      --rows npql_without_ap sac_without_ap

Trains the runs whose JSON files are missing in state_comparison/ next to this file, as
a sweep in runs/state_comparison: the same command again continues it. The rows of the
paper have equal budgets of environment steps, updates and candidates. Then plots
curves.png and writes table.md from all files there.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np

from apnpql_jax.cli.sweep import config_of as config_of_options
from apnpql_jax.config.files import config_diff, config_from_json, format_diff
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FAILED, RunStopped
from apnpql_jax.reports import figure, tables
from apnpql_jax.reports.groups import IGNORED, Group
from apnpql_jax.reports.reading import Run
from apnpql_jax.runs.metrics import read_rows
from apnpql_jax.sweeps import manifest, training
from apnpql_jax.sweeps.local import LocalLauncher
from apnpql_jax.sweeps.plan import Planned

OUT = Path(__file__).resolve().with_suffix("")

SWEEP = Path("runs/state_comparison")
"""Folder of the runs."""


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

EXPERT_STEPS = {"push_plate": 6_400}
"""Slots of the expert's replay; 25,600 for other tasks."""

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


def options_of(task: str, row: str, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  algorithm, flags, budget = ROWS[row]
  options = (
    f"--env.obs state --agent.algorithm {algorithm} --seed {seed} --no-video "
    "--env.worlds 32 --env.bank-rows 2048 "
    "--eval-acting policy --agent.candidate-precision float32 --agent.decay-updates 0 "
    "--replay.allow-unsolved "  # As when the stored results were made; no effect here.
    f"--replay.expert-steps {EXPERT_STEPS.get(task, 25_600)} "
    f"--total-steps {budget * STEPS} --eval-every {budget * STEPS // EVALUATIONS} "
    f"--agent.target-samples {CANDIDATES} --agent.policy-samples {CANDIDATES} {flags}"
  )
  return options.split()


def config_of(task: str, row: str, seed: int) -> TrainConfig:
  """Returns the settings of a run."""
  return config_of_options([task, *options_of(task, row, seed)])


def train(runs: list[tuple[str, str, int]], jobs: int) -> str:
  """Trains and evaluates runs (task, row, seed), and writes the result of each.

  Returns:
    What went wrong with some of them, or an empty text.
  """
  plan = [Planned(path_of(*run).stem, [run[0], *options_of(*run)]) for run in runs]
  sweep = manifest.open_folder(SWEEP, plan)
  failure = ""
  try:
    training.train(sweep, LocalLauncher(jobs))
  except RunStopped as stop:
    failure = str(stop)
    if stop.code != FAILED:
      sys.exit(failure)
  done = {entry.name for entry in sweep.runs if entry.state == manifest.DONE}
  for run in runs:
    if path_of(*run).stem in done:
      write_result(*run)
  return failure


def write_result(task: str, row: str, seed: int) -> None:
  """Evaluates a trained run and writes its result."""
  path = path_of(task, row, seed)
  run = SWEEP / path.stem
  play = f"--episodes {EPISODES} --seed {EPISODES_SEED} --json".split()
  play = [sys.executable, "-m", "apnpql_jax", "evaluate", str(run), *play]
  # "greedy" of the stored results: the highest Q of q, or the mean of a Gaussian.
  non_parametric = ROWS[row].algorithm == "ap_npql"
  final, greedy = (
    json.loads(subprocess.check_output([*play, "--acting", acting]))
    for acting in ("policy", "greedy" if non_parametric else "mean")
  )
  result = {
    "command": ["train", task, *options_of(task, row, seed)],
    "versions": json.loads((run / "versions.json").read_text()),
    "config": json.loads((run / "config.json").read_text()),
    "final": final,
    "greedy": greedy,
    "evaluations": evaluations(run),
  }
  part = path.with_suffix(".part")
  part.write_text(json.dumps(result, indent=1) + "\n")
  os.replace(part, path)
  print(f"{path.stem}: {final['successes']} of {EPISODES}", flush=True)


def evaluations(run: Path) -> list[dict[str, Any]]:
  """Returns the held-out evaluations, each with the training metrics before it."""
  found, last = [], {}
  for row in read_rows(run / "metrics.jsonl"):
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
      diff = config_diff(was, config_of(task, row, was.seed))
      # Presets may save at other times, for instance.
      if changed := {name: x for name, x in diff.items() if name not in IGNORED}:
        sys.exit(f"{path.name}: {format_diff(changed)}; remove it to train it again")
      found.setdefault((task, row), []).append(result)
  return found


def plot(found: dict[tuple[str, str], list[Result]]) -> None:
  """Plots a panel per task: the mean over seeds, and the range between them."""
  groups = [
    Group(task, row, [as_run(result) for result in found[task, row]])
    for task, row in itertools.product(TASKS, PAPER)
    if (task, row) in found
  ]
  figure.save(groups, OUT / "curves.png", axes=["steps"], band="range")


def table(found: dict[tuple[str, str], list[Result]]) -> str:
  """Returns a table of the success per seed and the steps to reach the goal."""
  goal = f"first at {100 * tables.GOAL:.0f} % after steps"
  solved = f"solved of {EPISODES}, by seed"
  rows = [["task", "row", "steps", solved, "mean", "greedy, by seed", goal]]
  for (task, row), results in found.items():
    runs = [as_run(result) for result in results]
    counts, greedy = (
      [result[kind]["successes"] for result in results] for kind in ("final", "greedy")
    )
    mean = f"{100 * np.mean(counts) / EPISODES:.0f} %"
    reached = tables.listed(tables.to_goal(run, "steps") for run in runs)
    budget = f"{ROWS[row].budget * STEPS:,}"
    listed = tables.listed(counts), mean, tables.listed(greedy)
    rows.append([task, row, budget, *listed, reached])
  runs = [as_run(result) for results in found.values() for result in results]
  made = f"Made at commit {tables.listed(tables.commits(runs))}."
  return f"{tables.markdown(rows)}\n\n{made}\n"


def as_run(result: Result) -> Run:
  """Returns a stored result as the reports of the package take it."""
  config = config_from_json(json.dumps(result["config"]))
  name = f"{config.env.task}-{config.agent.algorithm}-{config.seed}"
  kept = result["evaluations"], result["final"], result["versions"]
  return Run(name, config, *kept)


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
  wanted = itertools.product(args.seeds, args.tasks, args.rows)
  runs = [(task, row, seed) for seed, task, row in wanted]
  missing = [run for run in runs if not path_of(*run).exists()]
  failure = train(missing, args.jobs) if missing else ""
  found = results()
  plot(found)
  (OUT / "table.md").write_text(table(found))
  if failure:
    sys.exit(failure)


if __name__ == "__main__":
  main()
