"""Lines for the user on standard error."""

from __future__ import annotations

import contextlib
import sys


def say(line: str) -> None:
  """Prints a line; a standard error that cannot be written to is ignored."""
  with contextlib.suppress(OSError):
    print(line, file=sys.stderr, flush=True)
