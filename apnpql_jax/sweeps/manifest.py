"""Manifests: the plan of a sweep and what became of its runs, in one JSON file."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import json
from pathlib import Path
import shlex
from typing import Any, get_args

from apnpql_jax.errors import ConfigError, FileError
from apnpql_jax.reports import reading
from apnpql_jax.runs.run_folder import CONFIG_FILE, load_run_config
from apnpql_jax.runs.text import read_text, write_text
from apnpql_jax.sweeps.launcher import Launch, LauncherName, Work
from apnpql_jax.sweeps.plan import Planned

MANIFEST_FILE = "sweep.json"
"""A folder that holds this file is a sweep folder."""

_FORMAT = 1
_MAX_BYTES = 64 << 20

WAITING, RUNNING, DONE = "waiting", "running", "done"
FAILED, STOPPED = "failed", "stopped"
"""States of a run. ``FAILED`` and ``STOPPED`` runs are started again by a resume."""


@dataclasses.dataclass
class Entry:
  """A run of a sweep."""

  name: str
  argv: list[str]  # preset and options of ``apnpql train``
  state: str = WAITING
  attempts: int = 0
  code: int | None = None
  """Exit code of the last attempt; None if it has not ended."""

  line: str = ""
  """Last line of the log of an attempt that did not end well."""

  job: str = ""
  """Job of the cluster that runs it, if any."""


@dataclasses.dataclass
class Manifest:
  """A sweep folder and its runs. Only the process that holds its lock may save it."""

  folder: Path
  runs: list[Entry]
  launch: Launch = Launch()

  def run_dir(self, entry: Entry) -> Path:
    """Returns the run folder of an entry."""
    return self.folder / entry.name

  def work(self, entry: Entry) -> Work:
    """Returns what a launcher starts; the log has the output of all attempts."""
    log = self.folder / f"{entry.name}.log"
    return Work(entry.name, entry.argv, self.run_dir(entry), log)

  def refresh(self) -> None:
    """Reads from the run folders which runs are done; all others wait to be started.

    Takes jobs and attempts from the file, which another process may have saved since.
    """
    path = self.folder / MANIFEST_FILE
    runs = load_manifest(self.folder).runs if path.exists() else []
    saved = {run.name: run for run in runs}
    for index, entry in enumerate(self.runs):
      if (newer := saved.get(entry.name)) and newer.argv == entry.argv:
        self.runs[index] = newer
    for entry in self.runs:
      entry.state = DONE if self._finished(entry) else WAITING

  def save(self) -> None:
    """Writes the manifest; a killed process leaves the one before."""
    runs = [dataclasses.asdict(entry) for entry in self.runs]
    data = {
      "format": _FORMAT,
      "launch": dataclasses.asdict(self.launch),
      "runs": runs,
    }
    write_text(self.folder / MANIFEST_FILE, json.dumps(data, indent=1) + "\n")

  def add(self, plan: Sequence[Planned]) -> None:
    """Adds the runs of a plan that are not there yet.

    Raises:
      ConfigError: A run of that name was planned with other options.
    """
    known = {entry.name: entry for entry in self.runs}
    for name, argv in plan:
      if name not in known:
        self.runs.append(Entry(name, list(argv)))
      elif known[name].argv != argv:
        raise ConfigError(
          f"{str(self.folder)!r} has {name} with other options: apnpql train "
          f"{shlex.join(known[name].argv)}; choose another --out"
        )

  def _finished(self, entry: Entry) -> bool:
    run_dir = self.run_dir(entry)
    if not (run_dir / CONFIG_FILE).is_file():
      return False
    try:
      return reading.is_finished(run_dir, load_run_config(run_dir))
    except FileError:  # Training names what is wrong, in its log.
      return False


def load_manifest(folder: Path) -> Manifest:
  """Reads the manifest of a sweep.

  Raises:
    FileError: The folder is not that of a sweep, or its manifest cannot be read.
  """
  path = folder / MANIFEST_FILE
  if not path.is_file():
    raise FileError(
      f"{str(folder)!r} is not the folder of a sweep (no {MANIFEST_FILE}); "
      "`apnpql sweep PRESET` makes one"
    )
  try:
    data = json.loads(read_text(path, _MAX_BYTES))
    if data["format"] != _FORMAT:
      raise ValueError(f"format {data['format']}, not {_FORMAT}")
    runs = [_entry(run) for run in data["runs"]]
    launch = _launch(data.get("launch", {}))
  except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
    raise FileError(f"{path} cannot be read: {error}") from None
  return Manifest(folder.absolute(), runs, launch)


def open_folder(folder: Path, plan: Sequence[Planned]) -> Manifest:
  """Returns the sweep in a folder with the runs of a plan added; writes nothing.

  Raises:
    ConfigError: The folder holds something else, or a run with other options.
  """
  if (folder / MANIFEST_FILE).exists():
    manifest = load_manifest(folder)
  elif folder.exists() and any(folder.iterdir()):
    raise ConfigError(f"{str(folder)!r} holds something else; choose another --out")
  else:
    manifest = Manifest(folder.absolute(), [])
  manifest.add(plan)
  return manifest


def find_equal(root: Path, plan: Sequence[Planned]) -> Path | None:
  """Returns the newest sweep folder in ``root`` that has exactly this plan, if any."""
  wanted = [(run.name, run.argv) for run in plan]
  paths = root.glob(f"*/{MANIFEST_FILE}")
  for path in sorted(paths, key=lambda path: path.stat().st_mtime, reverse=True):
    try:
      found = load_manifest(path.parent)
    except FileError:
      continue
    if [(entry.name, entry.argv) for entry in found.runs] == wanted:
      return path.parent
  return None


def _entry(data: dict[str, Any]) -> Entry:
  """Returns a run read from JSON.

  Raises:
    ValueError: Its name could lead out of the folder, or an option is not a string.
  """
  entry = Entry(**data)
  if Path(entry.name).name != entry.name or entry.name in ("", ".", ".."):
    raise ValueError(f"{entry.name!r} is not a name of a run")
  if not all(isinstance(word, str) for word in entry.argv):
    raise ValueError(f"the options of {entry.name} are not texts")
  return entry


def _launch(data: dict[str, Any]) -> Launch:
  """Returns how to start runs, read from JSON; earlier files do not have it.

  Raises:
    ValueError, TypeError: It does not name a launcher and its settings.
  """
  launch = Launch(**data)
  settings = dict(launch.slurm)
  if launch.launcher not in get_args(LauncherName):
    raise ValueError(f"unknown launcher {launch.launcher!r}")
  if not all(isinstance(value, str | int) for value in settings.values()):
    raise ValueError("the settings of --slurm are not texts or numbers")
  if launch.jobs is not None and launch.jobs < 1:
    raise ValueError(f"jobs {launch.jobs}")
  return dataclasses.replace(launch, slurm=settings)
