"""The table at the top of docs/performance.md: what a user gets on two cores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.common.tables import number, table
from benchmarks.page.reports import Report, Result

NEEDED = ("env_steps", "learner", "end_to_end", "render", "compile_time", "peers")
"""Benchmarks whose reports it combines."""

PLAY = {"obs": "pixels", "worlds": 32}
TRAIN = PLAY | {"task": "push_plate", "backend": "native"}
UPDATE = {"batch": 64, "candidates": 120, "phi": "once"}
IMAGES = {"renderer": "ray_caster", "resolution": "paper", "shadow": False}
COLD = "seconds to the first iteration of training"


def answer(reports: Mapping[str, Report]) -> str:
  """Returns the most important figures, and the goals of the project."""

  def found(name: str, setting: Mapping[str, Any]) -> Iterator[Result]:
    results = reports[name]["results"]
    return (r for r in results if setting.items() <= r.items())

  def steps(backend: str) -> str:
    results = found("env_steps", PLAY | {"backend": backend})
    return span(r["env"]["steps_per_s"] for r in results)

  def start(kind: str) -> str:
    results = found("compile_time", {"backend": "native"})
    return span(r[kind]["seconds"] for r in results)

  def training(unit: str) -> str:
    return span(r[f"{unit}_per_s"] for r in found("end_to_end", TRAIN))

  peers = [r for r in found("peers", {}) if "PyBullet" in r["peer"] and "ratio" in r]
  updates = span(r["updates_per_s"] for r in found("learner", UPDATE))
  pairs = max(r["pairs_per_s"] for r in found("render", IMAGES))
  rows = [
    ("environment steps/s, C MuJoCo", steps("native"), "250 (800)", "env_steps"),
    ("environment steps/s, MJX", steps("mjx"), "60 (150)", "env_steps"),
    (
      "the same, ratio to PyBullet",
      span(r["ratio"] for r in peers[:1]),
      "3 (10)",
      "peers",
    ),
    ("updates/s, batch 64 with 120 candidates", updates, "15 (30)", "learner"),
    ("steps/s while training on push_plate", training("steps"), "", "end_to_end"),
    ("updates/s while training on push_plate", training("updates"), "", "end_to_end"),
    ("pairs of camera images/s", pairs, "", "render"),
    (COLD, start("cold"), "", "compile_time"),
    (f"{COLD}, with a compilation cache", start("warm"), "", "compile_time"),
  ]
  return table(("on two cores, from pixels", "figure", "goal (stretch)", "table"), rows)


def span(values: Iterator[float]) -> str:
  """Returns the lowest and the highest value, or the only one."""
  ordered = sorted(values)
  if not ordered:
    return "missing"
  return " to ".join(dict.fromkeys(map(number, (ordered[0], ordered[-1]))))
