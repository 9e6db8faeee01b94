"""Tables of groups and runs in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from apnpql_jax.reports import statistics
from apnpql_jax.reports.groups import Group, differing, settings, tasks_of, text
from apnpql_jax.reports.reading import Run

GOAL = 0.8
"""Success rate that "first at" refers to."""

Rows = list[list[str]]
"""Rows of cells; the first is the head."""


def compare(groups: Sequence[Group]) -> str:
  """Returns all tables with headings, and the commits of the runs."""
  parts = ["## Settings", markdown(of_groups(groups))]
  parts += ["## Runs", markdown(of_runs(groups))]
  if len(rows := of_settings(groups)) > 1:
    parts += ["## What differs", markdown(rows)]
  notes = [f"Success is the mean over runs and its {statistics.BANDS['interval']}."]
  if found := commits(run for group in groups for run in group.runs):
    notes.append(f"Made at commit {', '.join(found)}.")
  return "\n\n".join([*parts, " ".join(notes)]) + "\n"


def of_groups(groups: Sequence[Group]) -> Rows:
  """Returns a row per group: its success, and when it reached the goal."""
  goal = f"to {100 * GOAL:.0f} %"
  head = ["task", "settings", "runs", "success", "by seed"]
  rows = [[*head, f"steps {goal}", f"min {goal}", "steps", "min"]]
  for group in groups:
    runs = [run for run in group.runs if run.evaluations]
    row = [group.task, group.label or "-", str(len(group.runs))]
    if not runs:
      rows.append([*row, *["-"] * 6])
      continue
    rows.append(
      row
      + [str(statistics.last(runs)), solved(runs)]
      + [listed(to_goal(run, axis) for run in runs) for axis in statistics.AXES]
      + [listed(dict.fromkeys(f"{run.steps[-1]:,.0f}" for run in runs))]
      + [listed(f"{run.minutes[-1]:.1f}" for run in runs)]
    )
  return rows


def brief(groups: Sequence[Group]) -> Rows:
  """Returns the columns of ``of_groups`` that fit a terminal."""
  wanted = "task", "settings", "runs", "success", f"min to {100 * GOAL:.0f} %"
  head, *rows = of_groups(groups)
  columns = [index for index, name in enumerate(head) if name in wanted]
  return [[row[index] for index in columns] for row in (head, *rows)]


def of_runs(groups: Sequence[Group]) -> Rows:
  """Returns a row per run: when it reached the goal, and its last success."""
  goal = f"min to {100 * GOAL:.0f} %"
  several = len(groups) > 1
  group_head = ["task", "settings"] if several else []
  rows = [
    [*group_head, "seed", "run", goal, "min", "env steps", "solved", "rate (95 %)"]
  ]
  for group in groups:
    for run in group.runs:
      row = [group.task, group.label or "-"] if several else []
      row += [str(run.config.seed), run.name]
      if run.evaluations:
        minutes, steps = run.minutes[-1], run.steps[-1]
        row += [to_goal(run, "minutes"), f"{minutes:.1f}", f"{steps:,.0f}"]
        row += [solved([run]), str(statistics.last([run]))]
      else:
        row += ["no evaluation yet", *["-"] * 4]
      rows.append(row)
  return rows


def of_settings(groups: Sequence[Group], *, whole: bool = False) -> Rows:
  """Returns a row per setting that differs, or per setting, and a column per group."""
  values = [settings(group.runs[0].config) for group in groups]
  names = list(values[0]) if whole else differing(values)
  titles = [column(group, groups) for group in groups]
  rows = [["setting", *titles]]
  return rows + [[name, *(text(x[name]) for x in values)] for name in names]


def records(groups: Sequence[Group]) -> list[dict[str, Any]]:
  """Returns the groups as plain data, for JSON."""
  return [
    {
      "task": group.task,
      "settings": group.label,
      "success": statistics.last(runs)._asdict() if runs else None,
      "runs": [
        {
          "run": run.name,
          "seed": run.config.seed,
          "steps": run.steps,
          "minutes": run.minutes,
          "success": run.rates,
          "final": run.final,
        }
        for run in group.runs
      ],
    }
    for group in groups
    for runs in [[run for run in group.runs if run.evaluations]]
  ]


def column(group: Group, groups: Sequence[Group]) -> str:
  """Returns the title of a group among others, whose tasks may differ."""
  if len(tasks_of(groups)) == 1 or not group.label:
    return group.title
  return f"{group.task}: {group.label}"


def markdown(rows: Rows) -> str:
  """Returns a Markdown table."""
  lines = [
    "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows
  ]
  return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])


def listed(values: Iterable[object]) -> str:
  """Returns the values with commas between them."""
  return ", ".join(map(str, values))


def solved(runs: Sequence[Run]) -> str:
  """Returns such as ``62 of 64, 60 of 64``; percent if episodes are not known."""
  return listed(
    f"{rate * episodes:.0f} of {episodes}" if episodes else f"{100 * rate:.0f} %"
    for rate, episodes in statistics.solved(runs)
  )


def to_goal(run: Run, axis: str) -> str:
  """Returns steps or minutes to the goal, or that they were not enough."""
  digits = ",.0f" if axis == "steps" else ".1f"
  found = statistics.first_at(run, GOAL, axis)
  end = getattr(run, axis)[-1]
  return f"> {end:{digits}}" if found is None else f"{found:{digits}}"


def commits(runs: Iterable[Run]) -> list[str]:
  """Returns the commits that the runs were started at, sorted and shortened."""
  found = {git["commit"][:7] for run in runs if (git := run.versions.get("git"))}
  return sorted(found)
