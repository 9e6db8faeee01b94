"""The algorithms of the paper on all tasks: what the comparisons share.

A comparison trains the runs whose JSON files are missing in its folder, as a sweep: the
same command again continues it. Then it plots curves.png and writes table.md from all
files there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import dataclasses
import itertools
import json
from pathlib import Path
import subprocess
import sys
from typing import Any, NamedTuple

from apnpql_jax.atomic import replacing
from apnpql_jax.cli.sweep import check_begun, config_of as config_of_options
from apnpql_jax.config.files import config_from_json, format_diff
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FAILED, RunStopped, UserError
from apnpql_jax.reports import figure, statistics, tables
from apnpql_jax.reports.groups import Group, differences
from apnpql_jax.reports.reading import Run
from apnpql_jax.runs.metrics import metric_files, read_rows
from apnpql_jax.sweeps import training
from apnpql_jax.sweeps.local import LocalLauncher
from apnpql_jax.sweeps.manifest import DONE, Manifest
from apnpql_jax.sweeps.plan import Planned

TASKS = ("push_plate", "stack_box", "flip_cup", "place_plate")
PAPER = ("ap_npql", "ap_mpo", "ap_sac", "sac")
"""Rows of the paper's Fig. 5, which have equal budgets."""

KEPT = (
  *("loss/", "npql/", "prior/", "policy/", "q/", "ap/", "grad_norm/", "faults/"),
  "time/updates_per_s",
)
"""Prefixes of the training metrics that are stored with each evaluation."""

Result = dict[str, Any]
Found = dict[tuple[str, str], list[Result]]


class Row(NamedTuple):
  """An algorithm with its settings."""

  algorithm: str
  flags: str = ""
  """Options that change the preset of the task."""

  budget: int = 1
  """Factor on the environment steps of the other rows."""


@dataclasses.dataclass(frozen=True)
class Comparison:
  """Runs of rows on tasks with several seeds, and where their results are."""

  out: Path
  """Folder of the results."""

  sweep: Path
  """Folder of the runs."""

  rows: dict[str, Row]
  options: Callable[[str, str, int], list[str]]
  """(task, row, seed) -> command-line options that change the preset of the task."""

  play: str
  """Options of the evaluations after training."""

  greedy: Callable[[Row], str]
  """Row -> acting rule of the second evaluation; the first one draws actions."""

  second: str
  """Title of the second evaluation in the table."""

  more: Sequence[str] = ()
  """Acting rules of further evaluations."""

  axes: Sequence[str] = ("steps",)
  """Horizontal axes of the figure, see ``reports.figure``."""

  tasks: Sequence[str] = TASKS
  wanted: Sequence[str] = PAPER
  seeds: Sequence[int] = (0, 1, 2)
  """Tasks, rows and seeds that are trained if the command names no others."""

  def path_of(self, task: str, row: str, seed: int) -> Path:
    """Returns the file of a result."""
    return self.out / f"{task}-{row}-{seed}.json"

  def config_of(self, task: str, row: str, seed: int) -> TrainConfig:
    """Returns the settings of a run."""
    return config_of_options([task, *self.options(task, row, seed)])

  def train(self, runs: list[tuple[str, str, int]], jobs: int) -> str:
    """Trains and evaluates runs (task, row, seed), and writes the result of each.

    Returns:
      What went wrong with some of them, or an empty text.
    """
    plan = [
      Planned(self.path_of(*run).stem, [run[0], *self.options(*run)]) for run in runs
    ]
    sweep = Manifest(self.sweep.absolute(), [])  # Only these, not all in its folder.
    sweep.add(plan)
    failure = ""
    try:
      check_begun(sweep)
      training.train(sweep, LocalLauncher(jobs))
    except UserError as error:
      sys.exit(str(error))
    except RunStopped as stop:
      failure = str(stop)
      if stop.code != FAILED:
        sys.exit(failure)
    done = {entry.name for entry in sweep.runs if entry.state == DONE}
    for run in runs:
      if self.path_of(*run).stem in done:
        self.write_result(*run)
    return failure

  def write_result(self, task: str, row: str, seed: int) -> None:
    """Evaluates a trained run and writes its result."""
    path = self.path_of(task, row, seed)
    run = self.sweep / path.stem
    play = [sys.executable, "-m", "apnpql_jax", "evaluate", str(run), "--json"]
    rules = {"final": "policy", "greedy": self.greedy(self.rows[row])}
    rules |= {acting: acting for acting in self.more}
    played = {
      kind: json.loads(
        subprocess.check_output([*play, *self.play.split(), "--acting", acting])
      )
      for kind, acting in rules.items()
    }
    result = {
      "command": ["train", task, *self.options(task, row, seed)],
      "versions": json.loads((run / "versions.json").read_text()),
      "config": json.loads((run / "config.json").read_text()),
      **played,
      "evaluations": evaluations(run),
    }
    with replacing(path) as part:
      part.write_text(json.dumps(result, indent=1) + "\n")
    solved = tables.listed(str(x["successes"]) for x in played.values())
    print(f"{path.stem}: {solved} of {played['final']['episodes']}", flush=True)

  def results(self) -> Found:
    """Returns (task, row) -> the stored results, one per seed.

    Raises:
      SystemExit: A result was made with other settings than those of this file.
    """
    found: Found = {}
    for task, row in itertools.product(self.tasks, self.rows):
      for path in sorted(self.out.glob(f"{task}-{row}-*.json")):
        result = json.loads(path.read_text())
        was = config_from_json(json.dumps(result["config"]))
        if changed := differences(was, self.config_of(task, row, was.seed)):
          sys.exit(f"{path.name}: {format_diff(changed)}; remove it to train it again")
        found.setdefault((task, row), []).append(result)
    return found

  def plot(self, found: Found) -> None:
    """Plots a panel per task and axis: the mean over seeds, and their range."""
    groups = [
      Group(task, row, [as_run(result) for result in found[task, row]])
      for task, row in itertools.product(self.tasks, self.wanted)
      if (task, row) in found
    ]
    figure.save(groups, self.out / "curves.png", axes=self.axes, band="range")

  def table(self, found: Found) -> str:
    """Returns a table of the success per seed and the steps to reach the goal."""
    goal = f"first at {100 * tables.GOAL:.0f} % after steps"
    episodes = [result["final"]["episodes"] for x in found.values() for result in x]
    solved = f"solved of {tables.listed(sorted(set(episodes)))}, by seed"
    head = ["task", "row", "steps", solved, "mean (95 %)"]
    for title in (self.second, *self.more):
      head += [f"{title}, by seed", "mean (95 %)"]
    rows = [[*head, goal]]
    for (task, row), results in found.items():
      shown = [task, row, f"{as_run(results[0]).config.total_steps:,}"]
      for kind in ("final", "greedy", *self.more):
        counts = [result[kind]["successes"] for result in results]
        runs = [as_run(result, kind) for result in results]
        shown += [tables.listed(counts), str(statistics.last(runs))]
      reached = (tables.to_goal(as_run(result), "steps") for result in results)
      rows.append([*shown, tables.listed(reached)])
    runs = [as_run(result) for results in found.values() for result in results]
    made = f"Made at commit {tables.listed(tables.commits(runs))}."
    return f"{tables.markdown(rows)}\n\n{made}\n"

  def main(self, about: str) -> None:
    """Runs the command line of the script that ``about`` describes."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=self.tasks, default=self.tasks)
    parser.add_argument("--rows", nargs="+", choices=self.rows, default=self.wanted)
    parser.add_argument("--seeds", nargs="+", type=int, default=self.seeds)
    parser.add_argument("--jobs", type=int, default=1, help="runs at once")
    args = parser.parse_args()
    self.out.mkdir(exist_ok=True)
    self.results()  # Fails before hours of training.
    wanted = itertools.product(args.seeds, args.tasks, args.rows)
    runs = [(task, row, seed) for seed, task, row in wanted]
    missing = [run for run in runs if not self.path_of(*run).exists()]
    failure = self.train(missing, args.jobs) if missing else ""
    found = self.results()
    self.plot(found)
    (self.out / "table.md").write_text(self.table(found))
    if failure:
      sys.exit(failure)


def evaluations(run: Path) -> list[dict[str, Any]]:
  """Returns the held-out evaluations, each with the training metrics before it."""
  found, last = [], {}
  rows = (row for path in metric_files(run) for row in read_rows(path))
  for row in rows:
    last |= {name: x for name, x in row.items() if name.startswith(KEPT)}
    if "eval/success_rate" in row:
      names = ("step", "time/wall_s", "eval/success_rate", "eval/episodes")
      found.append({name: row[name] for name in names} | last)
  return found


def as_run(result: Result, kind: str = "final") -> Run:
  """Returns a stored result as the reports of the package take it."""
  config = config_from_json(json.dumps(result["config"]))
  name = f"{config.env.task}-{config.agent.algorithm}-{config.seed}"
  return Run(name, config, result["evaluations"], result[kind], result["versions"])
