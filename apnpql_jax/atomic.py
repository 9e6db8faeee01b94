"""Files that are written whole or not at all."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import os
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path, None, None]:
  """Yields a temporary name beside ``path``, which becomes ``path`` at the end.

  It has the same suffix, from which libraries guess the format. If the block raises,
  the temporary file is removed and ``path`` stays as it is. A link keeps its place, and
  a device is written directly.
  """
  path = path.resolve()
  if path.exists() and not path.is_file():
    yield path
    return
  part = path.with_stem(f"{path.stem}.part")
  try:
    yield part
    os.replace(part, path)
  except BaseException:
    part.unlink(missing_ok=True)
    raise
