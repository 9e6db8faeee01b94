"""Small text files, read within a limit and written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def read_text(path: Path, limit: int) -> str:
  """The text of a file that other people may have made.

  Raises:
    ValueError: it has more than ``limit`` bytes, or is not UTF-8.
  """
  with path.open("rb") as file:
    data = file.read(limit + 1)
  if len(data) > limit:
    raise ValueError(f"more than {limit} bytes")
  return data.decode("utf-8")


def write_text(path: Path, text: str) -> None:
  """Writes a file whole or not at all, so that a killed run leaves no half of one."""
  part = path.with_name(path.name + ".part")
  part.write_text(text, encoding="utf-8")
  os.replace(part, path)
