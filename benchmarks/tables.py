"""Tables in documents, made from the JSON of benchmarks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import json
import os
from pathlib import Path
import subprocess
from typing import Any

import jax
import mujoco

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PERFORMANCE = ROOT / "docs" / "performance.md"


def machine() -> dict[str, Any]:
  """What a figure was measured with; the commit is empty outside a checkout."""
  commit = subprocess.run(
    ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True
  )
  return {
    "commit": commit.stdout.strip(),
    "device": jax.devices()[0].device_kind,
    "cores": len(os.sched_getaffinity(0)),
    "versions": {module.__name__: module.__version__ for module in (jax, mujoco)},
  }


def store(name: str, report: dict[str, Any]) -> None:
  """Writes ``benchmarks/results/<name>.json``."""
  path = RESULTS / f"{name}.json"
  path.parent.mkdir(parents=True, exist_ok=True)
  path.write_text(json.dumps(report, indent=2) + "\n")


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
  """A table in Markdown; see ``number``."""
  lines = [head, ["---"] * len(head), *rows]
  return "\n".join("| " + " | ".join(map(number, line)) + " |" for line in lines)


def put(name: str, text: str, doc: Path = PERFORMANCE) -> None:
  """Replaces what stands between the marks of that name in a document."""
  begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
  before, found, rest = doc.read_text().partition(begin)
  _, closed, after = rest.partition(end)
  if not found or not closed:
    raise ValueError(f"{doc.name} has no marks {begin} and {end}")
  doc.write_text(f"{before}{begin}\n{text}\n{end}{after}")


def number(value: Any) -> str:
  """A cell; of a number three digits count."""
  if isinstance(value, float):
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
  return str(value)
