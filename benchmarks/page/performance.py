"""Tables and plots of docs/performance.md.

  python -m benchmarks.page.performance                    # from benchmarks/results
  python -m benchmarks.page.performance --measure          # measures all; takes hours
  python -m benchmarks.page.performance --measure render   # measures this one

A block of the document lies between two marks. Its tables are made from the stored
report of that name. Blocks whose report is missing stay as they are.
"""

import argparse
from collections.abc import Mapping, Sequence
import json
import math
from pathlib import Path
import subprocess
import sys
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.common import store, tables
from benchmarks.common.tables import number
from benchmarks.page import reports
from benchmarks.page.reports import Report
from benchmarks.peers.compare import PEERS, RATES

DOC = store.ROOT / "docs" / "performance.md"
BLOCKS = (
  *("fidelity", "render", "ray_layouts", "learner", "timeline", "encoder_layouts"),
  *("env_steps", "physics_timeline", "end_to_end", "compile_time", "growth"),
  *("memory", "peers", "stable_baselines"),
)
PANELS = 3  # panels of a plot side by side

NATIVE = {"backend": "native", "obs": "pixels", "worlds": 32}
MJX = NATIVE | {"backend": "mjx"}
TRAIN, START = NATIVE | {"task": "push_plate"}, {"backend": "native"}
UPDATE = {"batch": 64, "candidates": 120, "phi": "once"}
IMAGES = {"renderer": "ray_caster", "resolution": "paper", "shadow": False}
PEER = {"peer": PEERS["pybullet"].label, "rate": RATES["cameras"]}
ANSWER: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
  ("environment steps/s, C MuJoCo", "250 (800)", "env_steps.env.steps_per_s", NATIVE),
  ("the same as a ratio to PyBullet, 64 worlds", "3 (10)", "peers.ratio", PEER),
  ("environment steps/s, MJX", "60 (150)", "env_steps.env.steps_per_s", MJX),
  ("updates/s, batch 64, 120 candidates", "15 (30)", "learner.updates_per_s", UPDATE),
  ("steps/s while training on push_plate", "", "end_to_end.steps_per_s", TRAIN),
  ("updates/s while training on push_plate", "", "end_to_end.updates_per_s", TRAIN),
  ("pairs of camera images/s", "", "render.pairs_per_s", IMAGES),
  ("seconds to the first iteration, cold", "", "compile_time.cold.seconds", START),
  ("seconds to the first iteration, warm", "", "compile_time.warm.seconds", START),
)
"""What a user gets on two cores: row, goals, figure, and settings of the results."""


def main() -> None:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--measure", nargs="*", choices=BLOCKS, help="these, or all")
  args = parser.parse_args()
  failed = []
  for name in [] if args.measure is None else args.measure or BLOCKS:
    command = [sys.executable, "-m", reports.module(name), "--store"]
    if subprocess.run(command, cwd=store.ROOT).returncode:
      failed.append(name)
  write()
  if failed:
    sys.exit(f"failed: {', '.join(failed)}")


def write(results: Path = store.RESULTS, doc: Path = DOC) -> None:
  """Puts every stored report into the document, and draws the plots next to it."""
  files = {path.stem: path for path in results.glob("*.json")}
  found = {k: json.loads(files[k].read_text()) for k in BLOCKS if k in files}
  for name, report in found.items():
    tables.put(name, reports.block(report), doc)
  if found.keys() >= {figure.split(".")[0] for _, _, figure, _ in ANSWER}:
    tables.put("answer", answer(found), doc)
  if "gpu" in files:
    sections = json.loads(files["gpu"].read_text())["sections"].values()
    blocks = [reports.block(x["report"]) for x in sections if x["report"]["results"]]
    tables.put("gpu", "\n\n".join(blocks), doc)
  images = doc.parent / "images"
  images.mkdir(exist_ok=True)
  if "growth" in found:
    plot_growth(found["growth"], images / "growth.png")
  if "env_steps" in found and "end_to_end" in found:
    plot_rates(found["env_steps"], found["end_to_end"], images / "rates.png")


def answer(stored: Mapping[str, Report]) -> str:
  """Returns the table of ``ANSWER``, with the range over the results of each row."""
  rows = []
  for row, goal, figure, setting in ANSWER:
    name, *parents, key = figure.split(".")
    results = [r for r in stored[name]["results"] if setting.items() <= r.items()]
    for parent in parents:
      results = [r[parent] for r in results]
    values = sorted(r[key] for r in results if key in r)
    ends = dict.fromkeys(map(number, (values[0], values[-1]) if values else ()))
    rows.append((row, " to ".join(ends) or "missing", goal, name))
  head = ("on two cores, from pixels", "figure", "goal (stretch)", "table")
  return tables.table(head, rows)


def plot_growth(report: Report, out: Path) -> None:
  """Plots seconds by size, log-log, with a panel for each axis.

  Dashed lines grow in proportion to the size; dotted ones are the limit.
  """
  axes = reports.curves(report)
  rows = math.ceil(len(axes) / PANELS)
  figure = Figure(figsize=(3.2 * PANELS, 2.8 * rows), layout="constrained")
  panels = figure.subplots(rows, PANELS, squeeze=False)
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
    panel.set_xlabel(reports.UNITS.get(axis, axis))
    panel.legend()
  for panel in panels[:, 0]:
    panel.set_ylabel("time, s")
  figure.savefig(out, dpi=120)


def plot_rates(env_steps: Report, end_to_end: Report, out: Path) -> None:
  """Plots steps per second of the first task by worlds, with a panel per engine."""
  kinds = {"env": ("env", env_steps), "env_policy": ("env + policy", env_steps)}
  kinds[""] = ("env + policy + learning", end_to_end)
  task = env_steps["results"][0]["task"]
  found: dict[str, dict[str, dict[int, float]]] = {}
  for key, (label, report) in kinds.items():
    for r in report["results"]:
      if r["task"] == task:
        lines = found.setdefault(r["backend"], {}).setdefault(label, {})
        lines[r["worlds"]] = (r[key] if key else r)["steps_per_s"]
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


if __name__ == "__main__":
  main()
