"""What docs/performance.md says of several benchmarks, made of their reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tables import number, table

Reports = dict[str, dict[str, Any]]
"""By name of the benchmark."""

UPDATE = {"batch": 64, "candidates": 120}


def goals(reports: Reports) -> str:
  """What the project set out to reach on two cores, and what it has reached."""

  def slowest(backend: str) -> float:
    setting = {"backend": backend, "obs": "pixels", "worlds": 32}
    found = _results(reports, "env_steps", **setting)
    return min((result["env"]["steps_per_s"] for result in found), default=float("nan"))

  steps = "environment steps/s with both cameras, {}, 32 worlds, slowest task"
  rows = [
    (
      "updates/s from pixels, batch 64, 120 candidates",
      *(15, 30),
      _figure(reports, "learner", "updates_per_s", **UPDATE, phi="once"),
      "`learner.py`",
    ),
    (steps.format("C MuJoCo"), 250, 800, slowest("native"), "`env_steps.py`"),
    (steps.format("MJX"), 60, 150, slowest("mjx"), "`env_steps.py`"),
    (
      "times as many as the PyBullet set-up",
      *(3, 10, _ratio(reports, "PyBullet")),
      "`peers.py`",
    ),
  ]
  return table(("figure", "goal", "reach", "reached", "benchmark"), rows)


def costs(reports: Reports) -> str:
  """What was done about the largest costs."""

  def row(
    name: str, cost: str, before: dict[str, Any], after: dict[str, Any], cure: str
  ) -> tuple[Any, ...]:
    unit = "pairs" if name == "ray_layouts" else "updates"
    slow, fast = (
      _figure(reports, name, f"{unit}_per_s", **setting) for setting in (before, after)
    )
    figures = (f"{number(slow)} {unit}/s", fast, fast / slow)
    return (cost, *figures, cure, f"`{name}.py`")

  rows = [
    row(
      "learner",
      "values of 120 candidates, batch 64",
      UPDATE | {"phi": "repeated"},
      UPDATE | {"phi": "once"},
      "phi once per observation, first layer split",
    ),
    row(
      "encoder_layouts",
      "images in an update, batch 64",
      {"layout": "4x4 / 4, 2x2 / 2 by XLA"},
      {"layout": "4x4 / 4, 2x2 / 2"},
      "convolutions as products of matrices",
    ),
    (
      *("physics by MJX, 16 worlds", "", ""),
      _ratio(reports, "mujoco.mjx"),
      *("a barrier behind each body, cones in blocks, sums by XLA", "`peers.py`"),
    ),
    row(
      "ray_layouts",
      "both cameras, 32 worlds",
      {"layout": "fold, 1 block", "batch": 32},
      {"layout": "fold, 4 blocks", "batch": 32},
      "four blocks of pixels instead of one",
    ),
  ]
  head = ("cost", "before", "after", "times", "what does it", "benchmark")
  return table(head, rows)


def _results(reports: Reports, name: str, **setting: Any) -> list[dict[str, Any]]:
  found = reports[name]["results"]
  return [result for result in found if setting.items() <= result.items()]


def _figure(reports: Reports, name: str, figure: str, **setting: Any) -> float:
  """Of the first result with that setting; NaN if there is none."""
  found = _results(reports, name, **setting)
  return found[0][figure] if found else float("nan")


def _ratio(reports: Reports, peer: str) -> float:
  """The first ratio to a peer; NaN if it was not installed."""
  found = (r for r in reports["peers"]["results"] if peer in r["peer"])
  return next((r["ratio"] for r in found if "ratio" in r), float("nan"))


SUMMARIES: dict[str, tuple[Callable[[Reports], str], set[str]]] = {
  "goals": (goals, {"learner", "env_steps", "peers"}),
  "costs": (costs, {"learner", "encoder_layouts", "peers", "ray_layouts"}),
}
"""Name of a section -> what is said there, and of which reports."""
