"""The four algorithms of the paper on all tasks from states: curves and a table.

  python experiments/results/state_comparison.py                     # many hours
  python experiments/results/state_comparison.py --tasks push_plate --seeds 0

Trains whatever is missing in state_comparison/ beside this file, a JSON per run, with
equal budgets of environment steps, updates and candidates; then draws curves.png and
writes table.md from all that is there.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path
import subprocess
import sys
import tempfile

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from summarize import GOAL, evaluations

from apnpql_jax.run_folder import open_run

OUT = Path(__file__).resolve().with_suffix("")
ALGORITHMS = {
  "ap_npql": "",
  "ap_mpo": "",
  # Reverse KL. From a wider policy, KL to the narrow prior begins at 200 epsilon.
  "ap_sac": "--agent.epsilon 6 --agent.policy-initial-std 0.05",
  # A uniform prior: 4.85 - epsilon is the floor on the policy's entropy.
  "sac": "--agent.epsilon 10",
}
"""Name -> settings in which it differs from the preset of the task."""

STEPS = {"push_plate": 30_720, "stack_box": 61_440, "place_plate": 61_440}
STEPS["flip_cup"] = STEPS["stack_box"]
"""Environment steps per run; four of them for each update."""


def path_of(task: str, algorithm: str, seed: int) -> Path:
  """Where the evaluations of a run are kept."""
  return OUT / f"{task}-{algorithm}-{seed}.json"


def train(task: str, algorithm: str, seed: int) -> None:
  """One run, from which only its evaluations are kept."""
  with tempfile.TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    command = [sys.executable, "-m", "apnpql_jax", "train", task, "--run", str(run)]
    command += f"--obs state --algorithm {algorithm} --seed {seed}".split()
    command += f"--total-steps {STEPS[task]} --no-video".split()
    subprocess.run([*command, *ALGORITHMS[algorithm].split()], check=True)
    rows = evaluations(open_run(run))
  path_of(task, algorithm, seed).write_text(json.dumps(rows, indent=1) + "\n")


def results() -> dict[tuple[str, str], list[list[dict[str, float]]]]:
  """(task, algorithm) -> evaluations of each seed at hand."""
  found: dict[tuple[str, str], list[list[dict[str, float]]]] = {}
  for path in sorted(OUT.glob("*-*-*.json")):
    task, algorithm, _ = path.stem.split("-")
    found.setdefault((task, algorithm), []).append(json.loads(path.read_text()))
  return found


def plot(found: dict[tuple[str, str], list[list[dict[str, float]]]]) -> None:
  """A panel per task: mean over seeds, and from the lowest to the highest."""
  figure, panels = plt.subplots(
    1, len(STEPS), figsize=(3.4 * len(STEPS), 3.2), sharey=True, layout="constrained"
  )
  for panel, task in zip(panels, STEPS, strict=True):
    for algorithm in ALGORITHMS:
      if runs := found.get((task, algorithm)):
        rates = 100 * np.array([[row["eval/success_rate"] for row in r] for r in runs])
        steps = [row["step"] for row in runs[0]]
        panel.plot(steps, rates.mean(0), ".-", label=algorithm)
        panel.fill_between(steps, rates.min(0), rates.max(0), alpha=0.2)
    panel.set(title=task, xlabel="environment steps", ylim=(-2, 102))
  panels[0].set_ylabel("held-out success (%)")
  panels[0].legend()
  figure.savefig(OUT / "curves.png", dpi=120)


def table(found: dict[tuple[str, str], list[list[dict[str, float]]]]) -> str:
  """Final success of each seed, and the steps after which it was above the goal."""
  lines = [
    f"| task | algorithm | solved at the end, % | steps to {100 * GOAL:.0f} % |",
    "|---|---|---|---|",
  ]
  for (task, algorithm), runs in found.items():
    final = ", ".join(f"{100 * rows[-1]['eval/success_rate']:.0f}" for rows in runs)
    steps = ", ".join(map(_steps_to_goal, runs))
    lines.append(f"| {task} | {algorithm} | {final} | {steps} |")
  return "\n".join(lines) + "\n"


def _steps_to_goal(rows: list[dict[str, float]]) -> str:
  hits = [row["step"] for row in rows if row["eval/success_rate"] >= GOAL]
  return f"{hits[0]:,.0f}" if hits else "never"


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--tasks", nargs="+", choices=STEPS, default=list(STEPS))
  parser.add_argument(
    "--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS)
  )
  parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
  args = parser.parse_args()
  OUT.mkdir(exist_ok=True)
  for seed, task, name in itertools.product(args.seeds, args.tasks, args.algorithms):
    if not path_of(task, name, seed).exists():
      train(task, name, seed)
  found = results()
  plot(found)
  (OUT / "table.md").write_text(table(found))


if __name__ == "__main__":
  main()
