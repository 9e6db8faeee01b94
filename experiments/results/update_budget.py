"""What reaches 95 % first, from pixels: a fractional factorial design.

  python experiments/results/update_budget.py --jobs 2          # hours

See ``comparison``. Each factor has two levels. In half of their eight combinations,
both levels of a factor meet both levels of each other one, which is enough to estimate
the effect of each if their interactions are small. All runs of a task make as many
updates, so they differ in environment steps and in minutes. Effects are in effects.md.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from typing import NamedTuple

from comparison import Found, Result, Row, as_run
import numpy as np
import pixel_comparison

from apnpql_jax.config.files import load_preset
from apnpql_jax.reports import tables
from apnpql_jax.reports.statistics import first_at

GOAL = 0.95

FACTORS = {"candidates": (30, 100), "batch": (64, 128), "updates": (16, 64)}
"""Candidate actions per state, states per batch and updates per iteration."""

DESIGN = ((0, 0, 1), (1, 0, 0), (0, 1, 0), (1, 1, 1))
"""Levels of the factors by row."""

UPDATES = {"push_plate": 5_120, "stack_box": 10_240}
"""Updates of a run, with an evaluation after each sixteenth of them."""


def levels(row: tuple[int, ...]) -> dict[str, int]:
  """Returns the value of each factor in a row of the design."""
  return {name: FACTORS[name][i] for name, i in zip(FACTORS, row, strict=True)}


ROWS = {
  "_".join(f"{name}_{x}" for name, x in levels(row).items()): levels(row)
  for row in DESIGN
}


def options(task: str, row: str, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  config, level = load_preset(task), ROWS[row]
  iterations = UPDATES[task] // level["updates"]
  steps = config.env.worlds * config.rollout_length * iterations
  flags = (
    f"--agent.target-samples {level['candidates']} "
    f"--agent.policy-samples {level['candidates']} "
    f"--replay.batch-size {level['batch']} --updates-per-iteration {level['updates']} "
    f"--total-steps {steps} --eval-every {steps // 16}"
  )
  return pixel_comparison.options(task, Row("ap_npql", flags), seed)


COMPARISON = dataclasses.replace(
  pixel_comparison.variant(
    __file__,
    {row: Row("ap_npql") for row in ROWS},
    tasks=tuple(UPDATES),
    seeds=(0, 1),
    axes=("steps",),
  ),
  options=options,
)


class Time(NamedTuple):
  """Minutes of updates and rollouts until the goal, or until the end without it."""

  minutes: float
  reached: bool

  def __str__(self) -> str:
    return f"{'' if self.reached else '> '}{self.minutes:.1f}"


def time_of(result: Result) -> Time:
  """Returns the minutes of a run to the goal at the upper quartile of its speeds.

  Evaluations take no part, nor does other work on the machine that slows less than
  three quarters of the run.
  """
  run = as_run(result)
  speeds = [row["time/updates_per_s"] or 0.0 for row in run.evaluations]
  speed = float(np.quantile(speeds, 0.75))
  steps = first_at(run, GOAL, "steps")
  share = (steps or run.steps[-1]) / run.config.total_steps
  updates = share * UPDATES[run.config.env.task]
  return Time(updates / speed / 60, steps is not None)


def effects(tasks: Sequence[str], found: Found) -> str:
  """Returns tables of the minutes to the goal, and of the effect of each factor.

  An effect is the ratio of the minutes at the higher level to those at the lower one,
  as geometric means. Runs without the goal count with the minutes to their end.
  """
  times = {key: [time_of(result) for result in x] for key, x in found.items()}
  shown = [["task", *FACTORS, f"minutes to {100 * GOAL:.0f} %, by seed"]]
  ratios = [["task", *(f"{name}: {b} / {a}" for name, (a, b) in FACTORS.items())]]
  for task in tasks:
    for row, level in ROWS.items():
      listed = tables.listed(times.get((task, row), "-"))
      shown.append([task, *map(str, level.values()), listed])
    means = (
      [mean_log(times, task, name, value) for value in FACTORS[name]]
      for name in FACTORS
    )
    ratios.append([task, *(f"{np.exp(high - low):.2f}" for low, high in means)])
  return f"{tables.markdown(shown)}\n\n{tables.markdown(ratios)}\n"


def mean_log(
  times: dict[tuple[str, str], list[Time]], task: str, factor: str, value: int
) -> float:
  """Returns the mean logarithm of the minutes at a level of a factor; NaN if none."""
  rows = [row for row, level in ROWS.items() if level[factor] == value]
  logs = [np.log(x.minutes) for row in rows for x in times.get((task, row), ())]
  return float(np.mean(logs)) if logs else np.nan


if __name__ == "__main__":
  COMPARISON.main(__doc__)
  text = effects(COMPARISON.tasks, COMPARISON.results())
  (COMPARISON.out / "effects.md").write_text(text)
