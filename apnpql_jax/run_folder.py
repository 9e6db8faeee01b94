"""Run folder: its layout, and the record of the versions that made the run.

Module ``runs`` names, rejects and replaces folders.
"""

from __future__ import annotations

import dataclasses
import datetime
from importlib import metadata
import json
import os
from pathlib import Path
import platform
import subprocess
from typing import Any

from apnpql_jax import runs
from apnpql_jax.config import TrainConfig, config_to_json

_PACKAGES = (
  "apnpql-jax jax jaxlib flax optax distrax orbax-checkpoint mujoco mujoco-mjx mink "
  "numpy"
).split()


@dataclasses.dataclass(frozen=True)
class RunFolder:
  """Paths of one run; the folder exists and holds ``config.json``."""

  path: Path
  """The folder itself."""

  config: TrainConfig
  """The configuration the run was started with."""

  @property
  def versions(self) -> Path:
    """Software and devices of the run, see ``describe_versions``."""
    return self.path / "versions.json"

  @property
  def metrics_jsonl(self) -> Path:
    """Metrics, one JSON object per line."""
    return self.path / "metrics.jsonl"

  @property
  def curve(self) -> Path:
    """Plot of the success rate over steps and time."""
    return self.path / "curve.png"

  @property
  def videos(self) -> Path:
    """Folder of evaluation videos, created with the first one."""
    return self.path / "videos"

  @property
  def faults(self) -> Path:
    """Folder of recorded updates that were not finite, see ``faults``."""
    return self.path / "faults"


def create(
  run_dir: Path, config: TrainConfig, *, overwrite: bool = False, devices: int = 1
) -> RunFolder:
  """Creates the folder with ``config.json`` and ``versions.json``.

  Raises:
    ConfigError: the folder holds a run and ``overwrite`` is not set, it holds something
      other than a run, which is never removed, or it cannot be created.
  """
  runs.check_free(run_dir, overwrite=overwrite)
  versions = json.dumps(describe_versions(devices), indent=2) + "\n"
  with runs.fresh_run_dir(run_dir) as path:
    folder = RunFolder(path=path, config=config)
    write_text(folder.versions, versions)
    # Last, because this file marks the folder as a run.
    write_text(path / runs.CONFIG_FILE, config_to_json(config))
  return folder


def open_run(run_dir: Path) -> RunFolder:
  """Opens an existing run to resume or evaluate it.

  Raises:
    ConfigError: the folder is not a run, its configuration cannot be read, or links
      lead out of it.
  """
  runs.check_contained(run_dir)
  return RunFolder(path=run_dir.absolute(), config=runs.load_run_config(run_dir))


def changed_versions(folder: RunFolder, *, devices: int = 1) -> list[str]:
  """Returns changes since the run was created, such as ``jax 0.9.1 -> 0.10.2``.

  A run resumed with other versions or another device continues, but its numbers differ
  from those of an uninterrupted run. An unreadable record gives one line of its own.
  """
  try:
    old = _flat(json.loads(folder.versions.read_text(encoding="utf-8")))
  except (OSError, ValueError):
    return [f"{folder.versions.name} cannot be read"]
  new = _flat(describe_versions(devices))
  names = sorted((old.keys() | new.keys()) - {"created"})
  return [
    f"{name.rpartition('.')[2]} {old.get(name)} -> {new.get(name)}"
    for name in names
    if old.get(name) != new.get(name)
  ]


def describe_versions(devices: int) -> dict[str, Any]:
  """Returns versions of Python and packages, the git commit, devices and the time."""
  import jax  # Here, so that naming a run folder does not start JAX.

  return {
    "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    "python": platform.python_version(),
    "platform": platform.platform(),
    "packages": {name: _version(name) for name in _PACKAGES},
    "git": _git(Path(__file__).parent),
    "device": {
      "backend": jax.default_backend(),
      "kind": jax.devices()[0].device_kind,
      "count": devices,
    },
  }


def write_text(path: Path, text: str) -> None:
  """Writes a file atomically, so that a killed run leaves no partial file."""
  part = path.with_name(path.name + ".part")
  part.write_text(text, encoding="utf-8")
  os.replace(part, path)


def _version(package: str) -> str | None:
  try:
    return metadata.version(package)
  except metadata.PackageNotFoundError:
    return None


def _git(package_dir: Path) -> dict[str, Any] | None:
  """Returns the commit and whether files differ from it; None outside a checkout."""

  def git(*args: str) -> str:
    command = ["git", "-C", str(package_dir), *args]
    return subprocess.run(
      command, capture_output=True, text=True, check=True, timeout=10
    ).stdout.strip()

  try:
    # An installed package may lie inside an unrelated repository.
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
