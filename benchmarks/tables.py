"""Tables in documents, made from the JSON of benchmarks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import contextlib
from importlib import metadata
import json
import os
from pathlib import Path
import platform
import subprocess
from typing import Any

import jax

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
ENGINES = ("mujoco", "mujoco-mjx")
PERFORMANCE = ROOT / "docs" / "performance.md"


def machine() -> dict[str, Any]:
  """What a figure was measured with."""
  kind = jax.devices()[0].device_kind
  packages = {name: metadata.version(name) for name in ("jax", "jaxlib", *ENGINES)}
  return {
    "commit": commit(),
    "device": _processor() if kind == "cpu" else kind,
    "cores": len(os.sched_getaffinity(0)),
    "versions": {"python": platform.python_version(), **packages},
  }


def commit() -> str:
  """The short name of the commit; empty outside a checkout, or without git."""
  command = ["git", "rev-parse", "--short", "HEAD"]
  try:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
  except OSError:
    return ""
  return done.stdout.strip()


def _processor() -> str:
  """Linux's name of the CPU, else Python's."""
  with contextlib.suppress(OSError):
    for line in Path("/proc/cpuinfo").read_text().splitlines():
      name, _, value = line.partition(":")
      if name.strip() == "model name":
        return value.strip()
  return platform.processor() or platform.machine()


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
