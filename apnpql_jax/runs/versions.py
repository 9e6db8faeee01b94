"""The record of what a run was made with: versions, commit and devices."""

from __future__ import annotations

import datetime
from importlib import metadata
import json
from pathlib import Path
import platform
import subprocess
from typing import Any

_PACKAGES = (
  "apnpql-jax jax jaxlib flax optax distrax orbax-checkpoint mujoco mujoco-mjx mink "
  "numpy"
).split()


def changed_versions(path: Path, *, devices: int = 1) -> list[str]:
  """What differs between the record of a run and now, such as ``jax 0.9.1 -> 0.10.2``.

  A run resumed with other versions or another device learns on, but not bit by bit as
  it would have; without a readable record, that is the one line.
  """
  try:
    old = _flat(json.loads(path.read_text(encoding="utf-8")))
  except (OSError, ValueError):
    return [f"{path.name} cannot be read"]
  new = _flat(describe_versions(devices))
  names = sorted((old.keys() | new.keys()) - {"created"})
  return [
    f"{name.rpartition('.')[2]} {old.get(name)} -> {new.get(name)}"
    for name in names
    if old.get(name) != new.get(name)
  ]


def describe_versions(devices: int) -> dict[str, Any]:
  """Versions of Python and the packages, git commit of a checkout, devices, time."""
  import jax  # Here, so that naming a run folder does not start JAX.

  return {
    "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    "python": platform.python_version(),
    "platform": platform.platform(),
    "packages": {name: _version(name) for name in _PACKAGES},
    "git": _git(Path(__file__).parents[1]),
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
  """Commit and whether tracked files differ from it; None outside of a checkout."""

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


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
  flat: dict[str, Any] = {}
  for name, value in tree.items():
    if isinstance(value, dict):
      flat |= _flat(value, f"{prefix}{name}.")
    else:
      flat[prefix + name] = value
  return flat
