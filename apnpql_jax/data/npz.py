"""Safe reading of ``.npz`` files: arrays only, with sizes checked before allocation."""

from __future__ import annotations

from collections.abc import Set
import math
from pathlib import Path
import tokenize
import zipfile
import zlib

import numpy as np

from apnpql_jax.errors import FileError, UserError, one_line

# Exceptions raised for malformed archives.
_ERRORS = (OSError, ValueError, EOFError, KeyError, RuntimeError, MemoryError)
_ERRORS += (NotImplementedError, zipfile.BadZipFile, zlib.error)
_ERRORS += (LookupError, SyntaxError, TypeError, tokenize.TokenError)


def read(path: Path, *, limit: int) -> dict[str, np.ndarray]:
  """Reads all arrays of an archive, in native byte order, and executes nothing in it.

  Raises:
    FileError: The file is not an archive of arrays, is damaged, holds Python objects,
      or takes more than ``limit`` bytes.
  """
  try:
    with zipfile.ZipFile(path) as archive:
      names = archive.namelist()
      size = sum(_nbytes(archive, name) for name in names)
      if size > limit:
        raise FileError(f"{path} takes {size} bytes, more than {limit}")
      return {name.removesuffix(".npy"): _array(archive, name) for name in names}
  except UserError:
    raise
  except OSError as error:  # Missing, a folder, or not readable.
    raise FileError(f"cannot read {path}: {error.strerror or error}") from None
  except _ERRORS as error:
    raise FileError(f"{path} is not an .npz archive: {one_line(error)}") from None


def names(path: Path) -> list[str]:
  """Returns the names of the arrays in an archive, or none if it cannot be read."""
  try:
    with zipfile.ZipFile(path) as archive:
      return [name.removesuffix(".npy") for name in archive.namelist()]
  except _ERRORS:
    return []


def check_names(found: Set[str], wanted: Set[str]) -> None:
  """Raises ``FileError``, which lists missing and unknown arrays, if there are any."""
  lists = {"missing arrays": wanted - found, "unknown arrays": found - wanted}
  faults = [f"{what}: {', '.join(sorted(x))}" for what, x in lists.items() if x]
  if faults:
    raise FileError(f"{'; '.join(faults)} (see docs/demonstrations.md)")


def _nbytes(archive: zipfile.ZipFile, name: str) -> int:
  """Returns the size of an array in bytes, from its header."""
  with archive.open(name) as file:
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
      raise ValueError(f"{name}: unknown version {version}")
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
  if dtype.hasobject or any(n < 0 for n in shape):
    raise ValueError(f"{name}: {dtype}{list(shape)} is not a plain array")
  return math.prod(shape) * dtype.itemsize


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
  with archive.open(name) as file:
    array = np.lib.format.read_array(file, allow_pickle=False)
  return array.astype(array.dtype.newbyteorder("="), copy=False)  # JAX takes no other.
