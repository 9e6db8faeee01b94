"""Signals that stop a run: when to finish and save, and when to end at once.

Python runs signal handlers only between bytecode instructions, and a compilation or a
save is one instruction that takes minutes. A thread therefore watches for the signals
that end the process at once.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from pathlib import Path
import signal
import sys
import threading
import time
from typing import Any

from apnpql_jax.errors import INTERRUPTED

EMPTY_FOLDERS: set[Path] = set()
"""Folders to remove, if they are empty, when a signal ends the process at once."""

_ONE_REQUEST_S = 1.0
"""Signals closer than this are one: `timeout` and batch systems send it twice."""


class Signals:
  """Context manager that records SIGINT, SIGTERM and SIGHUP.

  Enter it in the main thread. A closed terminal sends SIGHUP. Where that is ignored, as
  under ``nohup``, it stays so.

  A signal prints a line and ends the process at once, with exit code ``INTERRUPTED``
  plus its number. After ``finish_first``, the first signal only sets ``caught``.
  """

  def __init__(self, message: str):
    """Sets the line that is printed when a signal ends the process."""
    self.caught: list[int] = []
    self._first: str | None = None
    self._message = message

  def finish_first(self, first: str, second: str) -> None:
    """Lets the first signal only set ``caught`` and print ``first``.

    The second one prints ``second`` and ends the process.
    """
    self._first, self._message = first, second

  def __enter__(self) -> Signals:
    self._woken, self._wake = os.pipe()
    os.set_blocking(self._wake, False)  # Required by the interpreter.
    self._wake_before = signal.set_wakeup_fd(self._wake)
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
      numbers.append(signal.SIGHUP)
    self._before: dict[int, Any] = {
      number: signal.signal(number, lambda number, _: self.caught.append(number))
      for number in numbers
    }
    threading.Thread(target=self._watch, daemon=True).start()
    return self

  def __exit__(self, *exception: object) -> None:
    for number, handler in self._before.items():
      signal.signal(number, handler)
    signal.set_wakeup_fd(self._wake_before)
    os.close(self._wake)

  def _watch(self) -> None:
    """Reads the numbers of signals, which the interpreter writes as they arrive."""
    first = None
    while byte := os.read(self._woken, 1):
      if byte[0] not in self._before:
        continue
      now = time.monotonic()
      if self._first is None or first is not None and now - first > _ONE_REQUEST_S:
        self._end(byte[0])
      elif first is None:
        first = now
        _write(f"{self._first}; once more to stop at once")
    os.close(self._woken)

  def _end(self, number: int) -> None:
    for child in multiprocessing.active_children():
      child.kill()  # They would wait for work forever.
    for path in tuple(EMPTY_FOLDERS):
      with contextlib.suppress(OSError):
        path.rmdir()
    if sys.stderr.isatty():
      os.write(2, b"\x1b[?25h")  # The cursor, which a progress bar hides.
    _write(f"apnpql: {self._message}")
    os._exit(INTERRUPTED + number)


def _write(line: str) -> None:
  """Bypasses Python's buffers, whose locks the main thread may hold."""
  with contextlib.suppress(OSError):  # The disk may be full.
    os.write(2, (line + "\n").encode())
