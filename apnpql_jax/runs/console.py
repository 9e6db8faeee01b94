"""Messages to the user on standard error."""

from __future__ import annotations

import contextlib
import sys


def print_line(line: str) -> None:
  """Prints a line to standard error; ignores failures to write."""
  with contextlib.suppress(OSError):
    print(line, file=sys.stderr, flush=True)
