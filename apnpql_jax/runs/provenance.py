"""Record of the versions, commit and devices that a run was started with."""

from __future__ import annotations

import datetime
from importlib import metadata
import json
from pathlib import Path
import platform
import subprocess
from typing import Any

from apnpql_jax.config import user_files

_PACKAGES = (
  "apnpql-jax jax jaxlib flax optax distrax orbax-checkpoint mujoco mujoco-mjx mink "
  "numpy"
).split()

_TASK = "task_file"
"""Key of the hash of the task's file."""


def changed_versions(run_dir: Path, *, devices: int = 1) -> list[str]:
  """Returns what changed since a run was started, such as ``jax 0.9.1 -> 0.10.2``.

  With other versions or another device a resumed run keeps learning, but not bit for
  bit. Returns one line if the record cannot be read.
  """
  from apnpql_jax.runs import leaves

  try:
    record = (run_dir / "versions.json").read_text(encoding="utf-8")
    old = leaves.named(json.loads(record))
  except (OSError, ValueError):
    return ["versions.json cannot be read"]
  new = leaves.named(describe_versions(devices))
  names = sorted((old.keys() | new.keys()) - {"created", _TASK})
  return [
    f"{name.rpartition('/')[2]} {old.get(name)} -> {new.get(name)}"
    for name in names
    if old.get(name) != new.get(name)
  ]


def changed_task(run_dir: Path, task_file: Path) -> bool:
  """Returns whether a task's file or MJCF differs from those that a run began with.

  False if the record cannot be read, which ``changed_versions`` reports.
  """
  try:
    record = json.loads((run_dir / "versions.json").read_text(encoding="utf-8"))
    return record[_TASK] != user_files.digest(task_file)
  except (OSError, ValueError, KeyError, TypeError):
    return False


def describe_versions(devices: int, task_file: str = "") -> dict[str, Any]:
  """Returns versions of Python and packages, git commit of a checkout, devices.

  ``task_file`` is that of ``EnvConfig``; its contents are recorded as a hash.
  """
  import jax  # Here, so that run folders can be named without JAX.

  return {
    "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    "python": platform.python_version(),
    "platform": platform.platform(),
    "packages": {name: _version(name) for name in _PACKAGES},
    "git": _git(Path(__file__).parents[1]),
    _TASK: user_files.digest(task_file) if task_file else None,
    "device": {
      "backend": jax.default_backend(),
      "kind": jax.devices()[0].device_kind,
      "count": devices,
    },
  }


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
