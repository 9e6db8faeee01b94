"""Messages to the user on standard error, none of which may cost a run."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import sys
from typing import Any, TextIO

from apnpql_jax.errors import one_line


class Unfailing:
  """Text stream that drops what its stream, which may be None, cannot take."""

  def __init__(self, stream: TextIO | None):
    """Wraps ``stream``; Python sets a closed ``sys.stderr`` to None."""
    self._stream = stream

  def write(self, text: str) -> int:
    """Writes if possible; returns the length of ``text``."""
    with contextlib.suppress(OSError, ValueError):
      if self._stream is not None:
        self._stream.write(text)
    return len(text)

  def flush(self) -> None:
    """Flushes if possible."""
    with contextlib.suppress(OSError, ValueError):
      if self._stream is not None:
        self._stream.flush()

  def isatty(self) -> bool:
    """Returns whether the stream is a terminal."""
    with contextlib.suppress(ValueError):
      return self._stream is not None and self._stream.isatty()
    return False

  def __getattr__(self, name: str) -> Any:
    return getattr(self._stream, name)


def print_line(line: str) -> None:
  """Prints a line to standard error; ignores failures to write."""
  print(line, file=Unfailing(sys.stderr), flush=True)


@contextlib.contextmanager
def reporting(purpose: str) -> Generator[None, None, None]:
  """Prints an error in one line instead of raising it: a report must not stop a run."""
  try:
    yield
  except Exception as error:  # Whatever the libraries of the report raise.
    print_line(f"cannot {purpose}: {one_line(error)}")
