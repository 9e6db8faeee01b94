"""Records in shared memory, through which the processes of the runtime talk.

Each record has one writer. A reader takes a copy, and takes another one if its number
or its checksum shows that the writer was at work. There are no locks, so a process that
dies cannot hold up the others for long. Times are those of ``time.monotonic``,
which all processes of a machine share.
"""

from __future__ import annotations

from collections.abc import Mapping
import enum
from multiprocessing import shared_memory
import time
from typing import Any
import zlib

import numpy as np

from apnpql_jax.errors import DeviceError

PERIOD_BINS, PERIOD_BIN_S = 64, 0.00025
"""Histogram of the periods of the control loop: number and width (s) of its bins."""

TEXT = "S200"
"""Type of a line in a record."""


class Phase(enum.IntEnum):
  """What the control process is to do, or does."""

  IDLE = 0
  """Reads the devices; the arm does not follow commands."""

  HOME = 1
  """Moves the arm to a pose."""

  PLAY = 2
  """Follows the policy."""

  QUIT = 3
  """Ends."""


RECORDS = {
  # From the main process.
  "order": [("number", "i8"), ("phase", "i8"), ("target", "f8", 6), ("close", "i8")],
  # From the control process; "number" is that of the order that "phase" obeys.
  "state": [
    ("number", "i8"),
    ("phase", "i8"),
    ("time", "f8"),
    ("position", "f8", 6),
    ("velocity", "f8", 6),
    ("wrench", "f8", 6),
    ("command", "f8", 6),
    ("gripper", "f8"),
    ("mode", "i8"),
    ("reason", TEXT),
    ("done", "i8"),
    ("periods", "i8", PERIOD_BINS),
  ],
  # From the policy process; "order" is that of the episode.
  "action": [
    ("order", "i8"),
    ("number", "i8"),
    ("time", "f8"),
    ("values", "f8", 7),
    ("frames", "f8", 2),
  ],
  "policy": [
    ("ready", "i8"),
    ("order", "i8"),
    ("actions", "i8"),
    ("over", "i8"),
    ("solved", "i8"),
    ("delay", "f8"),
    ("error", TEXT),
  ],
}
"""Record -> its fields."""

_TRIES = 1000


class Record:
  """A record that one process writes and others read."""

  def __init__(self, buffer: memoryview, fields: Any):
    """Lays the record over ``buffer``, see ``size``."""
    self._dtype = np.dtype(fields)
    head = np.frombuffer(buffer, np.uint64, 2)
    self._head, self._body = head, np.frombuffer(buffer, np.uint8, -1, 16)
    self._own: Any = np.zeros((), self._dtype)

  @staticmethod
  def size(fields: Any) -> int:
    """Returns the bytes of a record, a multiple of 64."""
    return -(-(16 + np.dtype(fields).itemsize) // 64) * 64

  def write(self, values: Mapping[str, Any]) -> None:
    """Changes the fields ``values`` and publishes the record."""
    for name, value in values.items():
      self._own[name] = value.encode()[:200] if isinstance(value, str) else value
    data = self._own.tobytes()
    self._head[0] += 1  # Odd: being written.
    self._body[: len(data)] = np.frombuffer(data, np.uint8)
    self._head[1] = zlib.crc32(data)
    self._head[0] += 1

  def read(self) -> Any:
    """Returns a copy of the newest whole record, by field; text is in bytes."""
    for attempt in range(_TRIES):
      number = int(self._head[0])
      data = self._body[: self._dtype.itemsize].tobytes()
      whole = number % 2 == 0 and number == self._head[0]
      # The checksum also covers processors that reorder writes.
      if whole and (number == 0 or self._head[1] == zlib.crc32(data)):
        return np.frombuffer(data, self._dtype)[0]
      if attempt > 10:
        time.sleep(1e-5)
    raise DeviceError("shared memory: a record stayed half-written; run again")

  def close(self) -> None:
    """Lets go of the memory."""
    del self._head, self._body


class Board:
  """All records of a run; also a context manager."""

  def __init__(self, name: str | None = None, records: Mapping[str, Any] | None = None):
    """Makes a board, or opens the one with this name; see ``RECORDS``."""
    records = RECORDS if records is None else records
    sizes = {key: Record.size(fields) for key, fields in records.items()}
    self._made = name is None
    self._memory = shared_memory.SharedMemory(
      name, create=self._made, size=sum(sizes.values())
    )
    start, buffer = 0, self._memory.buf
    assert buffer is not None
    self._records: dict[str, Record] = {}
    for key, fields in records.items():
      part = buffer[start : start + sizes[key]]
      self._records[key] = Record(part, fields)
      start += sizes[key]

  @property
  def name(self) -> str:
    """Its name for other processes."""
    return self._memory.name

  def __getitem__(self, record: str) -> Record:
    return self._records[record]

  def close(self) -> None:
    """Lets go of the memory, and removes it if this process has made it."""
    for record in self._records.values():
      record.close()
    self._records = {}
    try:
      self._memory.close()
    except BufferError:  # A copy of the view is still alive; the memory goes with it.
      pass
    if self._made:
      self._memory.unlink()

  def __enter__(self) -> Board:
    return self

  def __exit__(self, *error: object) -> None:
    self.close()
