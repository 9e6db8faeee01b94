"""Versions of the packages, and the extras, found without importing any of them."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
import platform
import re
import sys

import apnpql_jax
from apnpql_jax.doctor.findings import Finding
from apnpql_jax.errors import one_line

_NAME = "apnpql-jax"
_SOFTWARE = "software"
_EXTRAS = "extras"

EXTRAS = {
  "cuda": "trains on NVIDIA GPUs",
  "gym": "Gymnasium environments",
  "lerobot": "collect --format lerobot, convert from such datasets",
  "robot": "apnpql robot with real devices or their doubles",
  "sb3": "Stable-Baselines3",
  "sweep": "apnpql sweep --launcher slurm",
  "tb": "--sinks tensorboard",
  "transfer": "Bullet and TinyRenderer in apnpql transfer",
  "view": "apnpql watch in a browser",
  "wandb": "--sinks wandb",
}
"""Extra -> what it gives."""


def versions() -> Iterator[Finding]:
  """Yields the versions of Python, of the package and of what it requires."""
  place = Path(apnpql_jax.__file__).parent
  yield Finding(_SOFTWARE, _NAME, f"{apnpql_jax.__version__} in {place}")
  python = f"{platform.python_version()} in {sys.prefix}"
  yield Finding(_SOFTWARE, "python", python)
  yield Finding(_SOFTWARE, "system", platform.platform())
  found = {}
  for requirement in _requirements():
    if "extra" in requirement:
      continue
    name = _package(requirement)
    found[name] = _version(name)
    yield _judge(name, found[name], requirement)
  if found.get("mujoco") != found.get("mujoco-mjx"):
    versions = f"mujoco {found['mujoco']}, mujoco-mjx {found['mujoco-mjx']}"
    cure = "install the same version of mujoco and mujoco-mjx"
    yield Finding(_SOFTWARE, "MJX", versions, cure, needed=False)


def extras() -> Iterator[Finding]:
  """Yields which extras are installed, and what they give."""
  wanted: dict[str, list[str]] = {}
  for requirement in _requirements():
    if extra := re.search(r"""extra == ['"]([\w-]+)""", requirement):
      wanted.setdefault(extra[1], []).append(requirement)
  for extra in sorted(EXTRAS.keys() & wanted.keys()):
    missing = [x for x in map(_probe, wanted[extra]) if _version(x) is None]
    state = f"missing: pip install '{_NAME}[{extra}]'" if missing else "installed"
    yield Finding(_EXTRAS, extra, f"{EXTRAS[extra]}: {state}")


def _requirements() -> list[str]:
  """Returns the requirements as in the metadata; none if it was not installed."""
  try:
    return metadata.requires(_NAME) or []
  except metadata.PackageNotFoundError:
    return []


def _judge(name: str, version: str | None, requirement: str) -> Finding:
  """Returns whether a version satisfies a requirement."""
  bounds = requirement.partition(";")[0].strip()
  if version is None:
    cure = f"{name} is missing: pip install '{bounds}'"
    return Finding(_SOFTWARE, name, "missing", cure)
  try:
    from packaging.requirements import Requirement

    satisfied = Requirement(bounds).specifier.contains(version, prereleases=True)
  except ImportError:  # Not required; nearly always installed.
    satisfied = True
  except Exception as error:
    return Finding(_SOFTWARE, name, f"{version}; {one_line(error)}")
  cure = "" if satisfied else f"{name} {version} does not fit: pip install '{bounds}'"
  return Finding(_SOFTWARE, name, version, cure)


def _package(requirement: str) -> str:
  found = re.match(r"[\w.-]+", requirement)
  return found[0] if found else requirement


def _probe(requirement: str) -> str:
  """Returns the package that tells whether a requirement of an extra is met."""
  if requirement.startswith("jax["):  # jax itself is always there.
    return f"jax-{requirement.partition('[')[2].partition(']')[0]}-plugin"
  if "[warp]" in requirement:
    return "warp-lang"
  return _package(requirement)


def _version(package: str) -> str | None:
  try:
    return metadata.version(package)
  except metadata.PackageNotFoundError:
    return None
