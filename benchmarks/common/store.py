"""Stored results, and the machine they come from."""

import contextlib
from importlib import metadata
import json
from pathlib import Path
import platform
import re
import subprocess
from typing import Any

import jax

from apnpql_jax import runtime

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


def store(name: str, report: dict[str, Any]) -> None:
  """Writes ``benchmarks/results/<name>.json``."""
  write(RESULTS / f"{name}.json", report)


def write(path: Path, report: dict[str, Any]) -> None:
  """Writes a report as JSON; a reader never sees half of it."""
  part = path.with_suffix(".part")
  part.write_text(json.dumps(report, indent=2) + "\n")
  part.replace(path)


def machine() -> dict[str, Any]:
  """Returns commit, device, cores and versions; starts JAX."""
  kind = jax.devices()[0].device_kind
  packages = {name: metadata.version(name) for name in _PACKAGES}
  return {
    "commit": commit(),
    "device": _processor() if kind == "cpu" else kind,
    "cores": runtime.cores(),
    "versions": {"python": platform.python_version(), **packages},
  }


def commit() -> str:
  """Returns the short hash of the checkout; empty without git or outside a checkout."""
  command = ["git", "rev-parse", "--short", "HEAD"]
  with contextlib.suppress(OSError):
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip()
  return ""


def _processor() -> str:
  """Returns Linux's name of the CPU, otherwise Python's."""
  with contextlib.suppress(OSError):
    if found := re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text()):
      return found[1].strip()
  return platform.processor() or platform.machine()
