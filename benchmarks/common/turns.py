"""Turns of processes that share a device: many compile at once, one measures alone.

The GPU suite names a folder of lock files in the environment. Without it a process is
alone, and every turn is free.
"""

from collections.abc import Generator
import contextlib
import fcntl
import os
from pathlib import Path

FOLDER = "BENCHMARK_TURNS"  # environment variable with the folder of the lock files


@contextlib.contextmanager
def turn(*, shared: bool = False) -> Generator[None]:
  """Waits for a turn: to measure alone, or ``shared`` with others who compile."""
  folder = os.environ.get(FOLDER)
  if folder is None:
    yield
    return
  with (Path(folder) / "device").open("w") as file:
    fcntl.flock(file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
    yield  # Closing the file releases the lock.
