"""Pseudo-terminals, for tests of what is shown on a terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import struct
import termios


def terminal(columns: int) -> tuple[int, int]:
  """Returns the descriptors of both ends, that of the terminal last."""
  controller, end = pty.openpty()
  fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
  return controller, end


def read_all(controller: int) -> str:
  """Returns what was written to a terminal until its end is closed; closes this one."""
  text = b""
  with contextlib.suppress(OSError):  # Raised when nobody has the other end open.
    while part := os.read(controller, 1 << 16):
      text += part
  os.close(controller)
  return text.decode()
