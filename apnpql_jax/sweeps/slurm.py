"""Launcher on a Slurm cluster through submitit: a job per run, with the same manifest.

All nodes and the machine that starts the sweep share its folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import os
from pathlib import Path
import shutil
import signal
import subprocess
from typing import Any

from apnpql_jax.errors import INTERRUPTED, ConfigError, FileError, one_line
from apnpql_jax.sweeps.launcher import Job, Work

ALL_AT_ONCE = 1_000_000
"""Jobs at the same time, unless the user limits them: the cluster decides."""

DEFAULTS = {"name": "apnpql", "timeout_min": 24 * 60}
"""Default settings of the jobs; submitit's own time limit is only minutes."""

_TIMEOUTS = 1_000_000
"""How often a run may reach the end of its time; submitit's default is 3."""

_LOST = 1  # exit code of a job that ended without one


class Task:
  """Function of a job: trains a run as a process and passes signals on to it."""

  def __init__(self) -> None:
    """Starts nothing yet."""
    self._process: subprocess.Popen[bytes] | None = None

  def __call__(self, work: Work) -> int:
    """Trains or resumes the run; returns the exit code of ``apnpql train``."""
    with work.log.open("ab") as file:
      self._process = subprocess.Popen(
        work.command(), stdin=subprocess.DEVNULL, stdout=file, stderr=file
      )
    signal.signal(signal.SIGTERM, lambda *_: self._stop())
    try:
      return self._process.wait()
    finally:
      self._stop()

  def checkpoint(self, work: Work) -> Any:
    """Saves the run; called by submitit shortly before the job's time is over.

    Returns:
      The rest of the run, which submitit queues again.
    """
    from submitit.helpers import DelayedSubmission

    self._stop()
    if self._process is not None:
      # This runs inside of ``wait`` above, which holds a lock of ``Popen``.
      with contextlib.suppress(ChildProcessError):
        os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
    return DelayedSubmission(Task(), work)

  def _stop(self) -> None:
    if self._process is not None and self._process.poll() is None:
      self._process.send_signal(signal.SIGTERM)


class ClusterJob(Job):
  """A job of submitit."""

  def __init__(self, job: Any, cluster: str):
    """Wraps a job of the cluster ``slurm``, or of ``local`` processes."""
    self.name, self._job, self._cluster = job.job_id, job, cluster
    self.error, self._stopped = "", False

  def poll(self) -> int | None:
    """See ``Job.poll``."""
    if not self._job.done():
      return None
    try:
      return int(self._job.result())
    except Exception as error:  # Whatever the cluster did to the job.
      self.error = f"job {self.name}: {one_line(error)}"
      return INTERRUPTED + signal.SIGTERM if self._stopped else _LOST

  def stop(self) -> None:
    """See ``Job.stop``; a job that still waits leaves the queue.

    A plain ``scancel`` would kill the run half a minute later, while it still saves.
    """
    self._stopped = True
    if self._cluster == "local":
      with contextlib.suppress(ProcessLookupError):  # It has just ended.
        os.kill(int(self.name), signal.SIGTERM)
    elif self._job.state == "PENDING":
      self._job.cancel(check=False)
    else:
      subprocess.run(["scancel", "--signal=TERM", self.name], check=False)


class SlurmLauncher:
  """Launcher of jobs through submitit."""

  def __init__(
    self,
    folder: Path,
    *,
    jobs: int = ALL_AT_ONCE,
    settings: Mapping[str, Any] | None = None,
    cluster: str = "slurm",
  ):
    """Prepares submissions.

    Args:
      folder: Folder for the files of submitit.
      jobs: Jobs that wait or run at the same time.
      settings: Arguments of ``submitit.AutoExecutor.update_parameters``.
      cluster: ``slurm``, or ``local`` for processes on this machine.

    Raises:
      ConfigError: submitit or Slurm is missing, or a setting is unknown.
    """
    try:
      import submitit
    except ImportError:
      raise ConfigError(
        "--launcher slurm needs submitit: pip install 'apnpql-jax[sweep]'"
      ) from None
    if cluster == "slurm" and shutil.which("sbatch") is None:
      raise ConfigError(
        "--launcher slurm needs sbatch; run it on a machine of the cluster, or try "
        "--launcher slurm-local"
      )
    self.jobs, self._cluster = jobs, cluster
    try:
      self._executor = submitit.AutoExecutor(
        folder, cluster=cluster, **{f"{cluster}_max_num_timeout": _TIMEOUTS}
      )
      self._executor.update_parameters(**(DEFAULTS | dict(settings or {})))
    except (RuntimeError, ValueError, NameError, AssertionError) as error:
      raise ConfigError(f"--launcher slurm: {one_line(error)}") from None

  def start(self, work: Work) -> ClusterJob:
    """See ``Launcher.start``."""
    from submitit.core.utils import FailedSubmissionError

    try:
      return ClusterJob(self._executor.submit(Task(), work), self._cluster)
    except (FailedSubmissionError, subprocess.CalledProcessError) as error:
      raise FileError(f"cannot be submitted: {one_line(error)}") from None

  def find(self, name: str) -> ClusterJob | None:
    """See ``Launcher.find``."""
    if not name:
      return None
    job = self._executor._executor.job_class(self._executor.folder, name)
    return None if job.done(force_check=True) else ClusterJob(job, self._cluster)


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
  """Returns settings such as ``slurm_partition=gpu`` as arguments; numbers are ints.

  Raises:
    ConfigError: One is not written like that.
  """
  found: dict[str, Any] = {}
  for text in texts:
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier() or not value:
      raise ConfigError(f"--slurm {text!r} is not like timeout_min=240")
    found[name] = int(value) if value.isdecimal() else value
  return found
