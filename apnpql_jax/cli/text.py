"""Results as text that fits the terminal."""

from __future__ import annotations

from collections.abc import Iterable
import shutil
import sys
import textwrap

_NARROWEST = 12
"""Columns that a value needs next to its name; with fewer, it is on the next line."""


def width() -> int | None:
  """Returns the columns of the terminal; None if the output is not a terminal."""
  if not sys.stdout or not sys.stdout.isatty():
    return None
  return max(shutil.get_terminal_size().columns, 2 * _NARROWEST)


def rows(pairs: Iterable[tuple[str, str]]) -> list[str]:
  """Returns names and values in two columns, wrapped within the terminal."""
  pairs = list(pairs)
  column = max((len(name) for name, _ in pairs), default=0) + 2
  if (columns := width()) is not None and columns - column < _NARROWEST:
    column = 4
  lines = []
  for name, value in pairs:
    start = name.ljust(column) if len(name) < column else name
    if len(start) > column:
      lines += [start, *wrapped(value, " " * column, later=" " * column)]
    else:
      lines += wrapped(value, start, later=" " * column)
  return lines


def wrapped(line: str, start: str = "", later: str | None = None) -> list[str]:
  """Returns a line after ``start``; on a terminal, wrapped within its columns.

  ``later`` is before the next lines; as many spaces as ``start`` has if None.
  """
  if (columns := width()) is None:
    return [(start + line).rstrip()]
  return textwrap.wrap(
    line,
    columns,
    initial_indent=start,
    subsequent_indent=" " * len(start) if later is None else later,
    break_on_hyphens=False,
  ) or [start.rstrip()]
