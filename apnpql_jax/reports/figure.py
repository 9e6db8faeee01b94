"""Figures of success over steps and over wall clock, one panel per task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.reports import statistics
from apnpql_jax.reports.groups import Group, tasks_of
from apnpql_jax.reports.statistics import AXES, BANDS
from apnpql_jax.runs.metrics import EPISODES, STEP, SUCCESS, WALL, Row
from apnpql_jax.runs.success import interval_of_rate

if TYPE_CHECKING:
  from matplotlib.axes import Axes
  from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg", ".pdf")

_WIDTH, _HEIGHT = 3.3, 2.7  # of a panel in inches
_XLABELS = {"steps": "environment steps", "minutes": "wall-clock minutes"}


def save(
  groups: Sequence[Group],
  path: Path,
  *,
  axes: Sequence[str] = AXES,
  band: str = "interval",
) -> None:
  """Draws the groups, a column per task and a row per axis, and writes the file.

  Thin lines are single seeds. A single task has its axes side by side.

  Args:
    groups: Groups of runs; runs without an evaluation are left out.
    path: File to write; its suffix is one of ``SUFFIXES``.
    axes: Names in ``statistics.AXES``.
    band: A name in ``statistics.BANDS``.
  """
  tasks, colors = tasks_of(groups), colors_of(groups)
  rows, columns = (1, len(axes)) if len(tasks) == 1 else (len(axes), len(tasks))
  figure = _figure(_WIDTH * max(columns, 1.4), _HEIGHT * rows + 0.6)
  panels = figure.subplots(rows, columns, sharey=True, squeeze=False).T.ravel()
  if len(tasks) == 1:
    cells = [(tasks[0], axis) for axis in axes]
  else:
    cells = [(task, axis) for task in tasks for axis in axes]
  for panel, (task, axis) in zip(panels, cells, strict=True):
    members = [group for group in groups if group.task == task]
    draw(panel, members, axis, colors, band=band)
    if len(tasks) > 1 or axis == axes[0]:
      panel.set_title(task if axis == axes[0] else "", fontsize=10)
    if panel.get_subplotspec().is_first_col():
      panel.set_ylabel("held-out success (%)")
  handles = {
    line.get_label(): line
    for panel in panels
    for line in panel.get_lines()
    if not str(line.get_label()).startswith("_")
  }
  for ncols in range(max(1, min(len(handles), columns + 1)), 0, -1):
    legend = figure.legend(
      handles.values(),
      handles.keys(),
      loc="outside lower center",
      ncols=ncols,
      fontsize=8,
      frameon=False,
      title=caption(groups, band),
      title_fontsize=7,
    )
    figure.draw_without_rendering()
    if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
      break
    legend.remove()
  with replacing(path) as part:
    figure.savefig(part, dpi=140)


def plot_curve(rows: Sequence[Row], path: Path, *, title: str = "") -> None:
  """Draws the success rate over environment steps and over wall-clock minutes.

  The band is the 95 % interval, for rows that hold the number of episodes. Draws
  nothing if no row is an evaluation.
  """
  rows = [row for row in rows if row.get(SUCCESS) is not None]
  if not rows:
    return
  rates = [row[SUCCESS] or 0.0 for row in rows]
  episodes = [row.get(EPISODES) or 0 for row in rows]
  band = 100 * np.array([*map(interval_of_rate, rates, episodes)]).T
  figure = _figure(9.0, 3.6)
  axes = figure.subplots(1, 2, sharey=True)
  steps = [row[STEP] or 0.0 for row in rows]
  minutes = [(row.get(WALL) or 0.0) / 60 for row in rows]
  axes[0].set(xlabel="environment steps", ylabel="success of held-out episodes, %")
  axes[1].set(xlabel="wall-clock minutes")
  for axis, x in zip(axes, (steps, minutes), strict=True):
    axis.plot(x, [100 * rate for rate in rates], marker=".", color="C0")
    axis.fill_between(x, *band, alpha=0.25, color="C0", linewidth=0)
    axis.set(ylim=(-2, 102))
    axis.grid(alpha=0.3)
  figure.suptitle(title)
  with replacing(path) as part:
    figure.savefig(part, dpi=120)


def save_panel(
  groups: Sequence[Group],
  file: TextIO,
  axis: str,
  colors: Mapping[str, str],
  *,
  band: str = "interval",
  title: str = "",
) -> None:
  """Writes a panel of one task as SVG, whose text stays text."""
  from matplotlib import rc_context

  figure = _figure(_WIDTH * 1.25, _HEIGHT)
  panel = figure.subplots()
  draw(panel, groups, axis, colors, band=band)
  panel.set_title(title, fontsize=10)
  panel.set_ylabel("held-out success (%)")
  # The salt makes the identifiers the same each time, and different between panels.
  options: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": f"{title} {axis}"}
  with rc_context(options):
    figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})


def draw(
  panel: Axes,
  groups: Sequence[Group],
  axis: str,
  colors: Mapping[str, str],
  *,
  band: str = "interval",
) -> None:
  """Draws the curves of a task into a panel; the arguments are those of ``save``."""
  ends = [0.0]
  for group in groups:
    runs = [run for run in group.runs if run.evaluations]
    if not runs:
      continue
    color = colors[group.title]
    for run in runs if len(runs) > 1 else ():
      rates = [100 * rate for rate in run.rates]
      panel.plot(getattr(run, axis), rates, color=color, alpha=0.35, linewidth=0.7)
    x, mean, low, high = statistics.curve(runs, axis, band=band)
    marker = "." if len(x) < 30 else ""
    panel.plot(x, 100 * mean, marker=marker, color=color, label=group.title)
    panel.fill_between(x, 100 * low, 100 * high, color=color, alpha=0.15, linewidth=0)
    ends += [max(getattr(run, axis)) for run in runs]
  panel.set(ylim=(-2, 102), xlim=(0, 1.02 * max(ends) or 1.0), xlabel=_XLABELS[axis])
  panel.locator_params(axis="x", nbins=5)
  panel.grid(alpha=0.3)
  panel.spines[["top", "right"]].set_visible(False)
  if axis == "steps":
    panel.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:g}k" if x else "0")


def colors_of(groups: Sequence[Group]) -> dict[str, str]:
  """Returns title of a group -> color; a title has the same color in all panels."""
  from matplotlib import colormaps
  from matplotlib.colors import to_hex

  evaluated = (group for group in groups if any(x.evaluations for x in group.runs))
  titles = list(dict.fromkeys(group.title for group in evaluated))
  strong, pale = colormaps["tab10"], colormaps["tab20"]
  found = [strong(i) for i in range(10)] + [pale(i) for i in range(1, 20, 2)]
  return {title: to_hex(found[i % len(found)]) for i, title in enumerate(titles)}


def caption(groups: Sequence[Group], band: str) -> str:
  """Returns what bands and thin lines show."""
  text = f"band: {BANDS[band]}"
  if any(sum(bool(run.evaluations) for run in group.runs) > 1 for group in groups):
    text = f"line: mean over seeds; thin: single seeds; {text}"
  return text


def _figure(width: float, height: float) -> Figure:
  """Returns an empty figure."""
  # Not pyplot, which would choose a display for the whole process.
  from matplotlib.backends.backend_agg import FigureCanvasAgg
  from matplotlib.figure import Figure

  figure = Figure(figsize=(width, height), layout="constrained")
  FigureCanvasAgg(figure)
  return figure
