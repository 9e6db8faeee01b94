"""Small text files, read within a limit and written atomically."""

from __future__ import annotations

from pathlib import Path

from apnpql_jax.atomic import replacing


def read_text(path: Path, limit: int) -> str:
  """Returns the text of an untrusted file.

  Raises:
    ValueError: It has more than ``limit`` bytes, or is not UTF-8.
  """
  with path.open("rb") as file:
    data = file.read(limit + 1)
  if len(data) > limit:
    raise ValueError(f"more than {limit} bytes")
  return data.decode("utf-8")


def write_text(path: Path, text: str) -> None:
  """Writes a file atomically, so that a killed run leaves no half of one."""
  with replacing(path) as part:
    part.write_text(text, encoding="utf-8")
