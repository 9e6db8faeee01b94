"""Record of what a run was started with and what was changed, in ``versions.json``."""

from __future__ import annotations

from collections.abc import Mapping
import datetime
from importlib import metadata
import json
from pathlib import Path
import platform
import subprocess
from typing import Any

from apnpql_jax.config import user_files
from apnpql_jax.runs.text import read_text, write_text

FILE = "versions.json"

_MAX_BYTES = 1 << 20

_OF_THE_RUN = ("created", "origin", "changes", "task_file")
"""Entries that do not describe the machine and its software."""

_PACKAGES = (
  "apnpql-jax jax jaxlib flax optax distrax orbax-checkpoint mujoco mujoco-mjx mink "
  "numpy"
).split()


def changed_versions(run_dir: Path, *, devices: int = 1) -> list[str]:
  """Returns what changed since a run was started, such as ``jax 0.9.1 -> 0.10.2``.

  With other versions or another device a resumed run keeps learning, but not bit for
  bit. Returns one line if the record cannot be read.
  """
  from apnpql_jax.runs import leaves

  if (record := read(run_dir)) is None:
    return [f"{FILE} cannot be read"]
  old, new = (
    leaves.named({k: x for k, x in versions.items() if k not in _OF_THE_RUN})
    for versions in (record, describe_versions(devices))
  )
  names = sorted(old.keys() | new.keys())
  return [
    f"{name.rpartition('/')[2]} {old.get(name)} -> {new.get(name)}"
    for name in names
    if old.get(name) != new.get(name)
  ]


def read(run_dir: Path) -> dict[str, Any] | None:
  """Returns the record of a run, or None if it cannot be read."""
  try:
    record = json.loads(read_text(run_dir / FILE, _MAX_BYTES))
  except (OSError, ValueError, RecursionError):
    return None
  return record if isinstance(record, dict) else None


def write(run_dir: Path, record: Mapping[str, Any]) -> None:
  """Writes the record of a run."""
  write_text(run_dir / FILE, json.dumps(record, indent=2) + "\n")


def record_change(
  run_dir: Path, step: int, settings: Mapping[str, tuple[Any, Any]]
) -> None:
  """Adds to the record that ``settings`` (name -> old, new) change at ``step``."""
  record = read(run_dir) or {}
  earlier = record.get("changes")
  change = {"step": step, "created": _now(), "settings": settings}
  changes = [*(earlier if isinstance(earlier, list) else []), change]
  write(run_dir, record | {"changes": changes})


def changed_task(run_dir: Path, task_file: Path) -> bool:
  """Returns whether a task's file or MJCF differs from those that a run began with.

  False if the record cannot be read, which ``changed_versions`` reports.
  """
  recorded = (read(run_dir) or {}).get("task_file")  # None: the file has only a preset.
  return recorded not in (None, user_files.digest(task_file))


def describe_versions(devices: int, task_file: str = "") -> dict[str, Any]:
  """Returns versions of Python and packages, git commit of a checkout, devices.

  ``task_file`` is that of ``EnvConfig``; its contents are recorded as a hash.
  """
  import jax  # Here, so that run folders can be named without JAX.

  return {
    "created": _now(),
    "python": platform.python_version(),
    "platform": platform.platform(),
    "packages": {name: _version(name) for name in _PACKAGES},
    "git": _git(Path(__file__).parents[1]),
    "task_file": user_files.digest(task_file) if task_file else None,
    "device": {
      "backend": jax.default_backend(),
      "kind": jax.devices()[0].device_kind,
      "count": devices,
    },
  }


def _now() -> str:
  return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def _version(package: str) -> str | None:
  try:
    return metadata.version(package)
  except metadata.PackageNotFoundError:
    return None


def _git(package_dir: Path) -> dict[str, Any] | None:
  """Returns commit and whether tracked files differ; None outside of a checkout."""

  def git(*args: str) -> str:
    command = ["git", "-C", str(package_dir), *args]
    return subprocess.run(
      command, capture_output=True, text=True, check=True, timeout=10
    ).stdout.strip()

  try:
    # An installed package may lie inside somebody else's repository.
    git("ls-files", "--error-unmatch", "__init__.py")
    changes = git("status", "--porcelain", "--untracked-files=no")
    return {"commit": git("rev-parse", "HEAD"), "dirty": bool(changes)}
  except (OSError, subprocess.SubprocessError):
    return None
