"""Plots of docs/performance.md."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.page.reports import UNITS, Report, Result, curves

COLUMNS = 3
"""Panels side by side."""


def growth(report: Report, out: Path) -> None:
  """Plots seconds by size, log-log, with a panel for each axis.

  Dashed lines grow in proportion to the size; dotted ones are the limit.
  """
  axes = curves(report)
  rows = math.ceil(len(axes) / COLUMNS)
  figure = Figure(figsize=(3.2 * COLUMNS, 2.8 * rows), layout="constrained")
  panels = figure.subplots(rows, COLUMNS, squeeze=False)
  for panel in panels.flat[len(axes) :]:
    panel.set_visible(False)
  for panel, (axis, series) in zip(panels.flat, axes.items(), strict=False):
    for name, points in series.items():
      sizes = [point["size"] for point in points]
      line = panel.loglog(sizes, [p["seconds"] for p in points], "o-", label=name)[0]
      last = points[-1]
      in_proportion = [last["seconds"] * size / last["size"] for size in sizes]
      panel.loglog(sizes, in_proportion, "--", color=line.get_color(), linewidth=0.8)
      floors = [point["floor_s"] for point in points]
      panel.loglog(sizes, floors, ":", color=line.get_color(), linewidth=0.8)
    _mark(panel, sizes)
    panel.set_xlabel(UNITS[axis])
    panel.legend()
  for panel in panels[:, 0]:
    panel.set_ylabel("s")
  figure.savefig(out, dpi=120)


def rates(env_steps: Report, end_to_end: Report, out: Path) -> None:
  """Plots steps per second of the first task by worlds, with a panel per engine."""
  task = env_steps["results"][0]["task"]
  found: dict[str, dict[str, dict[int, float]]] = {}

  def put(result: Result, label: str, steps: float) -> None:
    if result["task"] == task:
      lines = found.setdefault(result["backend"], {})
      lines.setdefault(label, {})[result["worlds"]] = steps

  for result in env_steps["results"]:
    put(result, "env", result["env"]["steps_per_s"])
    put(result, "env + policy", result["env_policy"]["steps_per_s"])
  for result in end_to_end["results"]:
    put(result, "env + policy + learning", result["steps_per_s"])
  figure = Figure(figsize=(3.6 * len(found), 2.8), layout="constrained")
  panels = figure.subplots(1, len(found), squeeze=False, sharey=True)[0]
  for panel, (backend, lines) in zip(panels, found.items(), strict=True):
    for label, points in lines.items():
      worlds, steps = zip(*sorted(points.items()), strict=True)
      panel.loglog(worlds, steps, "o-", label=label)
    _mark(panel, worlds)
    panel.set(title=backend, xlabel="worlds")
  panels[0].set_ylabel("environment steps/s")
  handles = panels[0].get_legend_handles_labels()
  figure.legend(*handles, loc="outside upper center", ncols=3)
  figure.savefig(out, dpi=120)


def _mark(panel: Axes, sizes: Sequence[int]) -> None:
  """Puts ticks at these sizes only."""
  panel.set_xticks(sizes, labels=map(str, sizes), minor=False, fontsize="small")
  panel.set_xticks([], minor=True)
