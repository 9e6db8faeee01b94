"""Turns of processes that share a device: many compile at once, one measures alone.

The GPU suite names a folder of lock files in the environment. Without it a process is
alone, and every turn is free.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import fcntl
import os
from pathlib import Path

FOLDER = "BENCHMARK_TURNS"
"""Environment variable with the folder of the lock files."""


@contextlib.contextmanager
def compiling() -> Generator[None]:
  """Waits until nobody measures; others may compile at the same time."""
  with _lock("device", fcntl.LOCK_SH):
    yield


@contextlib.contextmanager
def measuring(what: str = "device") -> Generator[None]:
  """Waits until nobody compiles or measures, and keeps others from both."""
  with _lock(what, fcntl.LOCK_EX):
    yield


@contextlib.contextmanager
def _lock(name: str, kind: int) -> Generator[None]:
  folder = os.environ.get(FOLDER)
  if folder is None:
    yield
    return
  with (Path(folder) / name).open("w") as file:
    fcntl.flock(file, kind)  # Closing the file releases it.
    yield
