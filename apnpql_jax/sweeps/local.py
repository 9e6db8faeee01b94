"""Launcher on this machine: a process per run, each on its own share of the cores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import itertools
import os
from pathlib import Path
import signal
import subprocess

from apnpql_jax.sweeps.launcher import Job, Work


class LocalJob(Job):
  """A process that trains a run."""

  name = error = ""

  def __init__(self, process: subprocess.Popen[bytes], slot: int):
    """Wraps a process that occupies a slot of the launcher."""
    self._process, self.slot = process, slot

  def poll(self) -> int | None:
    """See ``Job.poll``."""
    return self._process.poll()

  def stop(self) -> None:
    """See ``Job.stop``."""
    if self._process.poll() is None:
      self._process.send_signal(signal.SIGTERM)


class LocalLauncher:
  """Launcher of processes that are pinned so that they do not starve each other."""

  def __init__(self, jobs: int):
    """Splits the cores and GPUs that this process may use into ``jobs`` shares."""
    self.jobs = jobs
    self._cores = shares(available_cores(), jobs)
    self._gpus = shares(visible_gpus(), jobs)
    self._per_gpu = -(-jobs // max(1, len(visible_gpus())))
    self._running: list[LocalJob] = []

  def start(self, work: Work) -> LocalJob:
    """See ``Launcher.start``."""
    self._running = [job for job in self._running if job.poll() is None]
    taken = {job.slot for job in self._running}
    slot = next(index for index in range(self.jobs) if index not in taken)
    with work.log.open("ab") as file:
      process = subprocess.Popen(
        work.command(),
        stdin=subprocess.DEVNULL,
        stdout=file,
        stderr=file,
        env=os.environ | self._settings(slot),
        process_group=0,  # Ctrl-C goes to this process only, which passes it on.
      )
    if self._cores[slot] and hasattr(os, "sched_setaffinity"):
      # Long before JAX starts its threads, which inherit it and count the cores.
      os.sched_setaffinity(process.pid, self._cores[slot])
    self._running.append(LocalJob(process, slot))
    return self._running[-1]

  def find(self, name: str) -> None:
    """See ``Launcher.find``; processes are not found again, but lock their runs."""
    del name

  def _settings(self, slot: int) -> Mapping[str, str]:
    """Returns the environment variables that give a process its share of the GPUs."""
    if not self._gpus[slot]:
      return {}
    settings = {"CUDA_VISIBLE_DEVICES": ",".join(self._gpus[slot])}
    if self._per_gpu > 1:  # JAX reserves most of the memory of a GPU otherwise.
      fraction = f"{0.9 / self._per_gpu:.3f}"
      settings["XLA_PYTHON_CLIENT_MEM_FRACTION"] = fraction
    return settings


def shares(items: Sequence, count: int) -> list[list]:
  """Splits items into ``count`` shares of neighbors; few items are used repeatedly.

  No item is in more than ``ceil(count / len(items))`` shares.
  """
  size = len(items)
  bounds = itertools.pairwise(i * size // count for i in range(count + 1))
  return [list(items[start : max(start + 1, end)]) for start, end in bounds]


def available_cores() -> list[int]:
  """Returns the cores that this process may use; none where they cannot be chosen."""
  if not hasattr(os, "sched_getaffinity"):  # On macOS.
    return []
  return sorted(os.sched_getaffinity(0))


def visible_gpus() -> list[str]:
  """Returns the NVIDIA GPUs that JAX would use."""
  given = os.environ.get("CUDA_VISIBLE_DEVICES")
  if given is not None:
    return [name.strip() for name in given.split(",") if name.strip() not in ("", "-1")]
  return [str(i) for i in range(len(list(Path("/proc/driver/nvidia/gpus").glob("*"))))]
