"""Several devices and processes: worlds and batches are split, all else is replicated.

The iteration stays one program for all worlds, which XLA partitions along its arrays:
random numbers equal those of one device, and results do within rounding. ``placement``
defines which parts of the state are split. Processes on several hosts share one run:
each computes for its own devices, and the first one writes and prints.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import ctypes
import itertools
from typing import Any

import jax
from jax.experimental import multihost_utils
from jax.sharding import Mesh, PartitionSpec
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.errors import ConfigError, one_line

AXIS = "worlds"  # the only axis of the mesh; batches are split along it too
_BARRIER_TIMEOUT_MS = 3_600_000
_barriers = itertools.count()


def join(coordinator: str, processes: int | None, process: int | None) -> None:
  """Joins the processes of a run, or raises ``ConfigError``; call it before JAX starts.

  ``coordinator`` is the address and port of the first process, or "auto" to get all
  three values from the batch system.
  """
  # The run handles signals itself; JAX would take over SIGTERM.
  jax.config.update("jax_enable_preemption_service", False)
  address = None if coordinator == "auto" else coordinator
  try:
    jax.distributed.initialize(address, processes, process)
  except (RuntimeError, TypeError, ValueError) as error:
    raise ConfigError(f"--coordinator {coordinator}: {one_line(error)}") from None


def start() -> list[jax.Device]:
  """Starts JAX if it has not started, and returns the devices of all processes.

  Raises ``ConfigError`` if the platform that it was asked for has none.
  """
  try:
    return jax.devices()
  except (RuntimeError, AssertionError) as error:
    config: Any = jax.config
    raise ConfigError(
      f"no device for JAX_PLATFORMS={config.jax_platforms}: {one_line(error)}"
    ) from None


def make_mesh(devices: int) -> Mesh | None:
  """Returns a mesh of the first devices, 0 for all; None for a single device.

  Raises ``ConfigError`` if there are fewer devices in all processes.
  """
  found = start()
  if not 0 <= devices <= len(found):
    raise ConfigError(f"--devices {devices} must be from 0 (all) to {len(found)}")
  chosen = found[: devices or None]
  return Mesh(np.array(chosen), (AXIS,)) if len(chosen) > 1 else None


def per_device(function: Callable[..., Any], mesh: Mesh | None) -> Callable[..., Any]:
  """Returns a function of arrays [worlds, ...] that each device runs on its own worlds.

  Worlds must not interact. XLA could not partition host calls, and would run a loop on
  all devices until the last world is done, with a message in every iteration.
  """
  if mesh is None:
    return function
  spec = PartitionSpec(AXIS)
  return jax.shard_map(
    function, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
  )


def local(tree: Any) -> Any:
  """Returns replicated arrays as arrays on the first device of this process."""
  return jax.tree.map(lambda x: x.addressable_data(0), tree)


def is_primary() -> bool:
  """Returns whether this is the first process, which writes and prints."""
  return jax.process_index() == 0


def run_on_primary(function: Callable[[], Any]) -> None:
  """Calls a function in the first process; the others wait until it returns."""
  if is_primary():
    function()
  barrier()


def any_process(flag: object) -> bool:
  """Returns in every process whether the flag is true in any of them."""
  barrier()
  return bool(multihost_utils.process_allgather(np.array(bool(flag))).any())


def barrier() -> None:
  """Waits until all processes have called this.

  Inside a compiled program CPUs wait at most 30 seconds for each other, so whatever
  takes processes different times must be followed by a barrier.
  """
  if jax.process_count() == 1:
    return
  from orbax.checkpoint import multihost

  wait = multihost.get_barrier_sync_fn()
  wait(key=f"apnpql_{next(_barriers)}", timeout_ms=_BARRIER_TIMEOUT_MS)


def check_memory(needed: int, what: str, available: int | None = None) -> None:
  """Raises ``ConfigError`` if memory, by default each device's, is below ``needed``."""
  free = available_memory() if available is None else available
  if free is not None and needed > free:
    raise ConfigError(
      f"{what} needs {needed / 2**30:.2f} GiB but {free / 2**30:.2f} GiB of memory "
      "are available; lower replay.capacity or replay.expert_steps"
    )


def available_memory() -> int | None:
  """Returns the free bytes per device, a share of RAM for CPUs; None if unknown."""
  stats = jax.local_devices()[0].memory_stats() or {}
  if "bytes_limit" in stats:
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
  host = runtime.host_memory()
  return None if host is None else host // jax.local_device_count()


def release_memory() -> None:
  """Returns freed memory to the OS, such as a gigabyte after a compilation.

  The GNU C library keeps it otherwise; does nothing with other libraries.
  """
  with contextlib.suppress(AttributeError, OSError):
    ctypes.CDLL(None).malloc_trim(0)
