"""Makes the tables and plots of docs/performance.md.

  python benchmarks/report.py                       # of what is in benchmarks/results
  python benchmarks/report.py --measure             # after measuring it all, for hours
  python benchmarks/report.py --measure render      # after measuring this anew

A section is a report in benchmarks/results, the script of that name that stores it, and
a pair of marks in the document. Those whose report is missing stay as they are.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import json
import math
from pathlib import Path
import subprocess
import sys

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import sections
import summaries
import tables

SECTIONS: dict[str, Callable[[sections.Report], str]] = {
  "fidelity": sections.fidelity,
  "render": sections.render,
  "ray_layouts": sections.ray_layouts,
  "learner": sections.learner,
  "encoder_layouts": sections.encoder_layouts,
  "env_steps": sections.env_steps,
  "end_to_end": sections.end_to_end,
  "compile_time": sections.compile_time,
  "growth": sections.growth,
  "peers": sections.peers,
  "gpu_suite": sections.gpu,
}
"""Name of a benchmark -> what is said of its report."""

MEASURED_HERE = [name for name in SECTIONS if name != "gpu_suite"]
"""The suite has a command line of its own, and needs a GPU."""

COLUMNS = 3
"""Of panels in a plot."""


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument(
    "--measure", nargs="*", choices=MEASURED_HERE, help="these, or all"
  )
  args = parser.parse_args()
  failed = []
  if args.measure is not None:
    failed = [name for name in args.measure or MEASURED_HERE if not measure(name)]
  write()
  if failed:
    sys.exit(f"failed: {', '.join(failed)}")


def measure(name: str) -> bool:
  """Runs a script, which stores its report; whether it came to its end."""
  script = tables.ROOT / "benchmarks" / f"{name}.py"
  return not subprocess.run([sys.executable, str(script), "--store"]).returncode


def write(results: Path = tables.RESULTS, docs: Path = tables.PERFORMANCE) -> None:
  """Puts every report at hand into the document, and draws the plots beside it."""
  paths = {name: results / f"{name}.json" for name in SECTIONS}
  found = {
    k: json.loads(path.read_text()) for k, path in paths.items() if path.exists()
  }
  for name, report in found.items():
    tables.put(name, SECTIONS[name](report), docs)
  for name, (summary, needed) in summaries.SUMMARIES.items():
    if found.keys() >= needed:
      tables.put(name, summary(found), docs)
  images = docs.parent / "images"
  images.mkdir(exist_ok=True)
  if "growth" in found:
    plot_growth(found["growth"], images / "growth.png")
  if "env_steps" in found and "end_to_end" in found:
    rates = sections.rates(found["env_steps"], found["end_to_end"])
    plot_rates(rates, images / "rates.png")


def plot_growth(report: sections.Report, out: Path) -> None:
  """Seconds by size, log-log, a panel for each axis; dashes grow in proportion, dots
  are the floor."""
  axes = sections.curves(report)
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
    panel.set_xlabel(sections.SIZES[axis])
    panel.legend()
  for panel in panels[:, 0]:
    panel.set_ylabel("s")
  figure.savefig(out, dpi=120)


def plot_rates(rates: sections.Rates, out: Path) -> None:
  """Steps per second by number of worlds, log-log, a panel for each engine."""
  figure = Figure(figsize=(3.6 * len(rates), 2.8), layout="constrained")
  panels = figure.subplots(1, len(rates), squeeze=False, sharey=True)[0]
  for panel, (backend, kinds) in zip(panels, rates.items(), strict=True):
    for label, points in kinds.items():
      worlds, steps = zip(*sorted(points.items()), strict=True)
      panel.loglog(worlds, steps, "o-", label=label)
    _mark(panel, worlds)
    panel.set(title=backend, xlabel="worlds")
  panels[0].set_ylabel("environment steps/s")
  lines = panels[0].get_legend_handles_labels()
  figure.legend(*lines, loc="outside upper center", ncols=3)
  figure.savefig(out, dpi=120)


def _mark(panel: Axes, sizes: Sequence[int]) -> None:
  """Marks nothing but these on the axis along which they grow."""
  panel.set_xticks(sizes, labels=map(str, sizes), minor=False, fontsize="small")
  panel.set_xticks([], minor=True)


if __name__ == "__main__":
  main()
