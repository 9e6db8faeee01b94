"""Runner of a sweep: starts what waits, records what ends, and stops on a signal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import signal
import time

from apnpql_jax.console import reporting
from apnpql_jax.errors import INTERRUPTED, UserError, one_line
from apnpql_jax.runs import run_folder
from apnpql_jax.sweeps.following import last_line
from apnpql_jax.sweeps.launcher import Job, Launcher
from apnpql_jax.sweeps.manifest import (
  DONE,
  FAILED,
  RUNNING,
  STOPPED,
  WAITING,
  Entry,
  Manifest,
)

_POLL_S = 0.5


class Runner:
  """Loop over the runs of a sweep. A run that fails must not affect the others."""

  def __init__(
    self, manifest: Manifest, launcher: Launcher, report: Callable[[Entry], None]
  ):
    """Starts nothing yet; ``report`` is called with each run whose state changes."""
    self._manifest, self._launcher, self._report = manifest, launcher, report
    self._active: dict[str, tuple[Entry, Job]] = {}

  def run(self, caught: Sequence[int], show: Callable[[], None]) -> None:
    """Trains all runs that are not done.

    Args:
      caught: Signals so far; after the first, the runs save and no other starts. At
        SIGHUP, from a closed terminal, jobs of a cluster continue.
      show: Called in every turn, to show the progress.
    """
    self._manifest.folder.mkdir(parents=True, exist_ok=True)
    with run_folder.lock(self._manifest.folder):
      self._manifest.refresh()
      self._manifest.save()
      self._find_again()
      stopping = False
      while self._active or (not caught and self._waiting()):
        if caught and not stopping:
          stopping = True
          self._stop(caught[0])
        if not caught:
          self._start()
        self._collect()
        show()
        time.sleep(_POLL_S)
      self._save()

  def _waiting(self) -> list[Entry]:
    return [entry for entry in self._manifest.runs if entry.state == WAITING]

  def _find_again(self) -> None:
    """Takes over the jobs that an earlier process has left running on a cluster."""
    for entry in self._waiting():
      if job := self._launcher.find(entry.job):
        self._active[entry.name] = entry, job
        self._change(entry, RUNNING)

  def _start(self) -> None:
    """Starts waiting runs while there is room."""
    # More may be in progress: an earlier process may have had room for them.
    room = max(0, self._launcher.jobs - len(self._active))
    for entry in self._waiting()[:room]:
      entry.attempts += 1
      entry.code, entry.line = None, ""
      try:
        job = self._launcher.start(self._manifest.work(entry))
      except (OSError, UserError) as error:
        entry.line = one_line(error)
        self._change(entry, FAILED)
        continue
      entry.job = job.name
      self._active[entry.name] = entry, job
      self._change(entry, RUNNING)

  def _stop(self, number: int) -> None:
    """Lets the active runs save and end, but not those that can be found again."""
    for entry, job in list(self._active.values()):
      if number == signal.SIGHUP and job.name:
        del self._active[entry.name]
      else:
        job.stop()

  def _collect(self) -> None:
    """Records the runs that have ended."""
    for entry, job in list(self._active.values()):
      if (code := job.poll()) is None:
        continue
      del self._active[entry.name]
      entry.code, entry.job = code, ""
      if code == 0:
        self._change(entry, DONE)
        continue
      entry.line = job.error or last_line(self._manifest.work(entry).log)
      if code < 0:
        entry.line = f"killed by signal {-code}; {entry.line}"
      # SIGTERM kills a run that has just started and does not listen yet.
      stopped = code > INTERRUPTED or code == -signal.SIGTERM
      self._change(entry, STOPPED if stopped else FAILED)

  def _change(self, entry: Entry, state: str) -> None:
    entry.state = state
    self._save()
    self._report(entry)

  def _save(self) -> None:
    """Saves the manifest if the disk permits; the run folders know what is done."""
    with reporting("save the manifest"):
      self._manifest.save()
