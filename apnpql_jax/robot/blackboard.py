"""A blackboard: records in shared memory, through which the processes talk.

Each record has one writer. A reader takes a copy, and takes another one if its number
or its checksum shows that the writer was at work. There are no locks, so a process that
dies, even within a write, does not hold up the others: they keep the last whole copy,
whose time shows its age. Times are those of ``time.monotonic``, which all processes of
a machine share.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import enum
from multiprocessing import shared_memory
from typing import Any
import weakref
import zlib

import numpy as np

PERIOD_BINS, PERIOD_BIN_S = 64, 0.00025
"""Histogram of the periods of the control loop: number and width (s) of its bins."""

TEXT = "S200"
"""Type of a line in a record."""

DESCRIPTION = "S4096"
"""Type of what a device says of itself, as JSON."""


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
  # From the control process; "number" is that of the order that "phase" obeys,
  # "unloaded" the wrench that the hand has read at home, NaN on the way.
  "state": [
    ("number", "i8"),
    ("phase", "i8"),
    ("time", "f8"),
    ("position", "f8", 6),
    ("velocity", "f8", 6),
    ("wrench", "f8", 6),
    ("command", "f8", 6),
    ("gripper", "f8"),
    ("gripper_time", "f8"),
    ("mode", "i8"),
    ("reason", TEXT),
    ("done", "i8"),
    ("at_rest", "i8"),
    ("unloaded", "f8", 6),
    ("periods", "i8", PERIOD_BINS),
  ],
  # From the control process, once they are connected: see ``Device.describe``.
  "devices": [("arm", DESCRIPTION), ("gripper", DESCRIPTION)],
  # From the policy process; "order" is that of the episode, "ended" that of the last
  # one that has ended and is in the log, "index" its number there or -1.
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
    ("missed", "i8"),
    ("over", "i8"),
    ("solved", "i8"),
    ("ended", "i8"),
    ("index", "i8"),
    ("delay", "f8"),
    ("error", TEXT),
  ],
}
"""Record -> its fields."""

_TRIES = 20
"""Attempts to take a whole copy, some microseconds each; a write is about as long."""

_HEAD = 16
"""Bytes before the values: number of the copy, odd while it is written; checksum."""


def text(value: Any) -> str:
  """Returns a field of text as it can be shown, whatever its bytes."""
  return bytes(value).decode(errors="replace")


class Record:
  """A record that one process writes and others read."""

  def __init__(self, buffer: memoryview, fields: Any):
    """Lays the record over ``buffer``, see ``size``."""
    self._dtype = np.dtype(fields)
    # Views that can be let go of: arrays would keep the memory open.
    self._head = buffer[:_HEAD].cast("Q")
    self._body = buffer[_HEAD : _HEAD + self._dtype.itemsize]
    self._own: Any = np.zeros((), self._dtype)
    self._good = self._own.tobytes()

  @staticmethod
  def size(fields: Any) -> int:
    """Returns the bytes of a record, a multiple of 64."""
    return -(-(_HEAD + np.dtype(fields).itemsize) // 64) * 64

  def write(self, values: Mapping[str, Any]) -> None:
    """Changes the fields ``values`` and publishes the record."""
    for name, value in values.items():
      if isinstance(value, str):
        value = _bytes(value, self._own[name].itemsize)
      self._own[name] = value
    data = self._own.tobytes()
    self._head[0] += 1  # Odd: being written.
    self._body[:] = data
    self._head[1] = zlib.crc32(data)
    self._head[0] += 1

  def read(self) -> Any:
    """Returns a copy of the newest whole record, by field; see ``text``.

    If the writer keeps writing, or has died while it wrote, this is the last copy that
    the reader took, or zeros if there was none.
    """
    for _ in range(_TRIES):
      number = self._head[0]
      data = bytes(self._body)
      whole = number % 2 == 0 and number == self._head[0]
      # The checksum also covers processors that reorder writes.
      if whole and number and self._head[1] == zlib.crc32(data):
        self._good = data
        break
    return np.frombuffer(self._good, self._dtype)[0]

  def close(self) -> None:
    """Lets go of the memory."""
    self._head.release()
    self._body.release()


class Blackboard:
  """All records of a run; also a context manager."""

  def __init__(self, name: str | None = None, records: Mapping[str, Any] | None = None):
    """Makes a blackboard, or opens the one with this name; see ``RECORDS``."""
    records = RECORDS if records is None else records
    sizes = {key: Record.size(fields) for key, fields in records.items()}
    memory = shared_memory.SharedMemory(
      name, create=name is None, size=sum(sizes.values())
    )
    self._memory, self._records = memory, {}
    buffer = memory.buf
    assert buffer is not None
    start = 0
    for key, fields in records.items():
      with buffer[start : start + sizes[key]] as part:
        self._records[key] = Record(part, fields)
      start += sizes[key]
    # Also at the exit of the interpreter, whose order of destruction is not ours.
    made = name is None
    self._close = weakref.finalize(self, _let_go, memory, self._records, made)

  @property
  def name(self) -> str:
    """Its name for other processes."""
    return self._memory.name

  def __getitem__(self, record: str) -> Record:
    return self._records[record]

  def close(self) -> None:
    """Lets go of the memory, and removes it if this process has made it."""
    self._close()

  def __enter__(self) -> Blackboard:
    return self

  def __exit__(self, *error: object) -> None:
    self.close()


def _let_go(
  memory: shared_memory.SharedMemory, records: Mapping[str, Record], made: bool
) -> None:
  for record in records.values():
    record.close()
  memory.close()
  if made:
    with contextlib.suppress(FileNotFoundError):  # Whoever ends this process may.
      memory.unlink()


def _bytes(line: str, size: int) -> bytes:
  """Returns text for a field of ``size`` bytes; a longer one ends in an ellipsis."""
  data = line.encode(errors="replace")  # Names of files may have lone surrogates.
  if len(data) <= size:
    return data
  end = "…".encode()
  return data[: size - len(end)].decode(errors="ignore").encode() + end
