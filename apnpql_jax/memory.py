"""Memory a run may take, asked before it takes it."""

from __future__ import annotations

import os
from pathlib import Path

from apnpql_jax.errors import ConfigError

_MEMINFO = Path("/proc/meminfo")
_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


def check_memory(needed: int, what: str, available: int | None = None) -> None:
  """Refuses what does not fit, before it is allocated.

  Args:
    needed: bytes about to be taken.
    what: name of the thing in the message.
    available: bytes free; asked of the machine if None.

  Raises:
    ConfigError: ``needed`` is more than is free.
  """
  free = available_memory() if available is None else available
  if free is not None and needed > free:
    raise ConfigError(
      f"{what} needs {needed / 2**30:.2f} GiB but {free / 2**30:.2f} GiB of memory "
      "are available; lower replay.capacity or replay.expert_steps"
    )


def available_memory() -> int | None:
  """Bytes free on each device: its memory, else its share of RAM; None if unknown."""
  import jax  # Here, because this starts its backend and takes a second to import.

  stats = jax.local_devices()[0].memory_stats() or {}
  if "bytes_limit" in stats:
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
  host = host_memory()
  return None if host is None else host // jax.local_device_count()


def host_memory() -> int | None:
  """Bytes of RAM that are free and allowed to this process; None if unknown."""
  bounds = [b for b in (_free_memory(), _container_limit()) if b is not None]
  return min(bounds, default=None)


def _free_memory() -> int | None:
  try:
    lines = dict(x.split(":", 1) for x in _MEMINFO.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024
  except (OSError, KeyError, ValueError):
    pass
  try:  # Not Linux: the memory there is, free or not.
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
  except (AttributeError, OSError, ValueError):
    return None


def _container_limit() -> int | None:
  try:
    return int(_CGROUP_LIMIT.read_text())
  except (OSError, ValueError):  # No such limit, or the word "max".
    return None
