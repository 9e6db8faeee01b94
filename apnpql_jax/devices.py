"""Several devices: worlds and batches are split between them, all else is on each.

The iteration stays one program for all worlds, which XLA splits where its arrays are
split: random numbers are those of one device, and results are too, within rounding.
Where the parts of the state lie is said in ``iteration``. Processes on several hosts
share one run: each computes for its own devices, and the first one tells of it.
"""

from __future__ import annotations

from collections.abc import Callable
import itertools
import os
from pathlib import Path
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, PartitionSpec
import numpy as np

from apnpql_jax.errors import ConfigError, one_line

AXIS = "worlds"
"""The one axis of the mesh; batches are split along it too."""

_MEMINFO = Path("/proc/meminfo")
_CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
_PATIENCE_MS = 3_600_000
_meetings = itertools.count()


def join(coordinator: str, processes: int | None, process: int | None) -> None:
  """Makes this process one of those of a run; before anything starts JAX's backend.

  Args:
    coordinator: address and port of the first process; "auto" if the batch system
      knows it and the rest.
    processes: how many share the run.
    process: which of them this is, from 0.

  Raises:
    ConfigError: they do not find each other.
  """
  # Signals are our own business: JAX would take SIGTERM for itself.
  jax.config.update("jax_enable_preemption_service", False)
  address = None if coordinator == "auto" else coordinator
  try:
    jax.distributed.initialize(address, processes, process)
  except (RuntimeError, TypeError, ValueError) as error:
    raise ConfigError(f"--coordinator {coordinator}: {one_line(error)}") from None


def make_mesh(devices: int) -> Mesh | None:
  """The devices of a run in a row, or None if it is one.

  Args:
    devices: how many; 0 for all those of all processes.

  Raises:
    ConfigError: there are not as many.
  """
  found = jax.devices()
  if not 0 <= devices <= len(found):
    raise ConfigError(f"--devices {devices} must be within 0 (all) and {len(found)}")
  chosen = found[: devices or None]
  return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def per_device(function: Callable[..., Any], mesh: Mesh | None) -> Callable[..., Any]:
  """A function of arrays [worlds, ...] that each device applies to its own worlds.

  For what every world does by itself. XLA would split it too, but not calls of the
  host, and a loop would run on all devices until the last world of all is done, with
  a message between them each time.
  """
  if mesh is None:
    return function

  spec = PartitionSpec(AXIS)
  return jax.shard_map(
    function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
  )


def local(tree: Any) -> Any:
  """What is on each device as arrays of this process's first one alone."""
  return jax.tree.map(lambda x: x.addressable_data(0), tree)


def leads() -> bool:
  """Whether this is the process that writes and tells, the first or the only one."""
  return jax.process_index() == 0


def first_alone(function: Callable[[], Any]) -> None:
  """Calls it in the first process; the others go on when it is done."""
  if leads():
    function()
  meet()


def anywhere(flag: object) -> bool:
  """Whether it is true in any process, the same answer in all of them."""
  meet()
  return bool(multihost_utils.process_allgather(np.array(bool(flag))).any())


def meet() -> None:
  """Returns when all processes have come here, however long that takes.

  Within a program, CPUs wait for each other no longer than 30 seconds: what takes one
  process longer than another must be followed by this.
  """
  if jax.process_count() == 1:
    return
  from orbax.checkpoint import multihost

  wait = multihost.get_barrier_sync_fn()
  wait(key=f"apnpql_{next(_meetings)}", timeout_ms=_PATIENCE_MS)


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
