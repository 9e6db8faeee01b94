"""Cores, memory, caches and disks, found without JAX and MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import platform
import shutil
import tempfile
import time

from apnpql_jax import runtime
from apnpql_jax.atomic import check_writable, existing
from apnpql_jax.config import checks, files
from apnpql_jax.doctor.findings import Finding, size
from apnpql_jax.errors import UserError, one_line

_MACHINE = "machine"
_DISK = "disk"
_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_WRITTEN = 16 << 20  # bytes, to measure a disk
_SLOW = 20e6  # bytes per second, at which a checkpoint of a preset takes half a minute
_ROOM = 2 << 30  # bytes, for the checkpoints of a preset
_LARGE = 10 << 30  # bytes of a cache


def cores() -> Iterator[Finding]:
  """Yields how many cores there are, and how many this process may use."""
  usable, found = runtime.cores(), os.cpu_count() or 1
  text = f"{usable} of {found} ({platform.machine()})"
  quota = _quota()
  if quota is not None:
    text += f", limited to the time of {quota:.3g} by the container"
  cure = ""
  if min(usable, quota or usable) < 2:
    reason = "the affinity (taskset)" if usable < found else "the container"
    limit = f"; {reason} allows no more" if found > 1 else ""
    cure = f"one core: simulation and learning take turns; give it two{limit}"
  yield Finding(_MACHINE, "cores", text, cure, needed=False)


def memory(free: int | None) -> Iterator[Finding]:
  """Yields for which presets of this package there is too little memory.

  ``free`` is the number of bytes on the device that will train; None if unknown.
  """
  free = runtime.host_memory() if free is None else free
  if free is None:
    yield Finding(_MACHINE, "memory", "unknown")
    return
  wants = {
    name: checks.replay_bytes(files.load_preset(name)) + checks.PROCESS_BYTES
    for name in files.own_preset_names()  # Others may import JAX, or fail.
  }
  short = [name for name, needed in wants.items() if needed > free]
  most = max(wants.values())
  text = f"{size(free)} free; the presets need up to {size(most)}"
  cure = ""
  if short:
    cure = f"too little memory for {', '.join(short)}: free some, or lower "
    cure += "--replay.capacity and --replay.expert-steps"
  yield Finding(_MACHINE, "memory", text, cure, needed=len(short) == len(wants))


def caches() -> Iterator[Finding]:
  """Yields where the caches are, their sizes and the speed of their disk."""
  if (folder := runtime.cache_dir()) is None:
    cure = "you have no home folder for the caches: set XDG_CACHE_HOME"
    yield Finding(_DISK, "cache", "none", cure)
    return
  compiled = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or folder / "xla")
  for name, path in (("reset states", folder / "banks"), ("programs", compiled)):
    number, total = _contents(path)
    text = f"{path}: {number:,} files, {size(total)}"
    large = f"{path} is large; it can be deleted and is filled again"
    yield Finding(_DISK, name, text, large if total > _LARGE else "", needed=False)
  yield from _disk("cache", folder, "set XDG_CACHE_HOME")


def run_folders() -> Iterator[Finding]:
  """Yields the room and speed of the disk on which ``runs`` is."""
  yield from _disk("runs", Path("runs").absolute(), "use another folder, or --run")


def _disk(name: str, folder: Path, cure: str) -> Iterator[Finding]:
  try:
    check_writable(folder)
    speed = _write_speed(existing(folder))
    free = shutil.disk_usage(existing(folder)).free
  except (UserError, OSError) as error:
    yield Finding(_DISK, name, one_line(error), f"{folder} is not writable: {cure}")
    return
  text = f"{folder}: {size(free)} free, writes {speed / 1e6:,.0f} MB/s"
  change, needed = "", True
  if free < _ROOM:
    change = f"{folder} has little room for checkpoints: free some, or {cure}"
  elif speed < _SLOW:
    change = f"the disk of {folder} is slow: {cure}"
    needed = False
  yield Finding(_DISK, name, text, change, needed)


def _write_speed(folder: Path) -> float:
  """Returns bytes per second with which a file reaches the disk."""
  data = os.urandom(_WRITTEN)
  with tempfile.TemporaryFile(dir=folder) as file:
    began = time.monotonic()
    file.write(data)
    file.flush()
    os.fsync(file.fileno())
    return _WRITTEN / max(time.monotonic() - began, 1e-6)


def _contents(folder: Path) -> tuple[int, int]:
  """Returns the number and total bytes of the files in a folder."""
  sizes = []
  for place, _, names in os.walk(folder):
    for name in names:
      with contextlib.suppress(OSError):  # Another process may delete it.
        sizes.append((Path(place) / name).stat().st_size)
  return len(sizes), sum(sizes)


def _quota() -> float | None:
  """Returns the CPU time per time that the container allows; None without a limit."""
  with contextlib.suppress(OSError, ValueError):
    used, period = _QUOTA.read_text().split()
    return int(used) / int(period)
  return None
