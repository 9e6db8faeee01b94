"""The interface of launchers, which start runs and find out when they have ended."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import dataclasses
from pathlib import Path
import sys
from typing import Literal, NamedTuple, Protocol

from apnpql_jax.config import user_files
from apnpql_jax.runs.run_folder import CONFIG_FILE

LauncherName = Literal["local", "slurm", "slurm-local"]


@dataclasses.dataclass(frozen=True)
class Launch:
  """Launcher settings of a sweep, stored so that a resume starts runs the same way."""

  launcher: LauncherName = "local"
  slurm: Mapping[str, str | int] = dataclasses.field(default_factory=dict)
  """Settings of the jobs as submitit names them."""

  jobs: int | None = None
  """Runs at the same time; the launcher decides if None."""


class Work(NamedTuple):
  """A run to start or to resume."""

  name: str
  argv: list[str]  # preset and options of ``apnpql train``
  run_dir: Path
  log: Path  # to which the output is added

  def command(self) -> list[str]:
    """Returns the command that starts the run, or resumes it if it has begun."""
    run_dir = str(self.run_dir)
    rest = [*self.argv, "--run", run_dir]
    if (self.run_dir / CONFIG_FILE).is_file():
      rest = ["--resume", run_dir, *self._not_stored()]
    return [sys.executable, "-m", "apnpql_jax", "train", *rest]

  def _not_stored(self) -> list[str]:
    """Returns the options that no run stores, so that a resume needs them again."""
    preset = self.argv[0] if self.argv else ""
    file = str(user_files.task_file(self.argv) or preset)
    options = ["--task-file", file] if user_files.is_file(file) else []
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--devices")
    devices = parser.parse_known_args(self.argv)[0].devices
    return options if devices is None else [*options, "--devices", devices]


class Job(Protocol):
  """A run in progress."""

  name: str
  """Name of the job in a cluster, to find it again; empty if that is impossible."""

  error: str
  """Why a job has no exit code of its own; otherwise empty."""

  def poll(self) -> int | None:
    """Returns the exit code of ``apnpql train``, or None while it runs."""

  def stop(self) -> None:
    """Sends SIGTERM, at which the run saves and ends."""


class Launcher(Protocol):
  """Interface of what starts runs, on this machine or elsewhere."""

  jobs: int
  """Runs at the same time."""

  def start(self, work: Work) -> Job:
    """Starts a run; fewer than ``jobs`` are in progress.

    Raises:
      OSError, UserError: It cannot be started.
    """

  def find(self, name: str) -> Job | None:
    """Returns a job of an earlier process that is still in progress, if any."""
