"""Files that are written whole or not at all, in folders checked beforehand."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import os
from pathlib import Path
import tempfile

from apnpql_jax.errors import FileError


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path, None, None]:
  """Yields a temporary path; when the block ends, that file replaces ``path``.

  It is in the same folder and has the same suffix, from which libraries guess the
  format. If the block raises, the temporary file is removed and ``path`` is unchanged.
  If ``path`` is a link, the file that it leads to is replaced. A device is written
  directly.
  """
  path = path.resolve()
  if path.exists() and not path.is_file():
    yield path
    return
  part = path.with_stem(f"{path.stem}.part{os.getpid()}")
  try:
    yield part
    os.replace(part, path)
  except BaseException:
    part.unlink(missing_ok=True)
    raise


def check_utf8(path: Path) -> None:
  """Checks that C libraries, which take paths as UTF-8, find the same file as Python.

  Raises:
    FileError: They do not, because of the locale or of the bytes of a name.
  """
  name = str(path.absolute())
  try:
    same = os.fsencode(name) == name.encode()
  except UnicodeEncodeError:
    same = False
  if not same:
    raise FileError(
      f"{name!a} is not UTF-8, or the locale is not; set LC_ALL=C.UTF-8, or rename it"
    )


def existing(path: Path) -> Path:
  """Returns the path itself or, if it does not exist, its nearest folder that does."""
  return next(found for found in (path, *path.absolute().parents) if found.exists())


def check_writable(folder: Path) -> None:
  """Checks that files can be made in a folder or, if it is missing, that it can be.

  Raises:
    FileError: They cannot; nothing is left behind.
  """
  try:
    with tempfile.TemporaryFile(dir=existing(folder)):
      pass
  except OSError as error:
    raise FileError(f"cannot write to {str(folder)!r}: {error.strerror}") from None
