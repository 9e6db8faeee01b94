"""Record of a checkpoint: its configuration, success rate and leaves.

The record is read before the arrays, so that a wrong, damaged or oversized checkpoint
is rejected before memory is allocated for it. It holds checksums of the leaves and of
itself, because Orbax silently casts a leaf of another dtype and misses flipped bits.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
import json
import operator
import os
from pathlib import Path
from typing import Any, NamedTuple
import zlib

from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FileError, UserError, one_line
from apnpql_jax.runs import leaves, text
from apnpql_jax.runs.segments import Segment

SCHEMA_VERSION = 3
"""Version of the format; incremented whenever the format changes."""

_READABLE = (2, SCHEMA_VERSION)  # Version 2 has no segments.

_FILE = "meta/metadata"  # in the folder of a checkpoint

_MAX_BYTES = 16 << 20
"""Limit for the file of a record, which takes a few hundred bytes per leaf."""

_MALFORMED = (OSError, ValueError, RecursionError, LookupError, TypeError)
_MALFORMED += (AttributeError,)
"""Exceptions raised for malformed records."""


class DamagedError(FileError):
  """A checkpoint that differs from what was written; an older one may be intact."""


class Leaf(NamedTuple):
  """One array of a checkpoint."""

  kind: str  # dtype and shape, see ``leaves.kind``
  key_impl: str | None  # generator of a typed PRNG key, see ``leaves.key_impl``
  crc32: int | None  # of the bytes; None if the array is in segments


class Record(NamedTuple):
  """Content that ``describe`` wrote and ``read`` verified."""

  config: dict[str, Any]
  success_rate: float | None
  items: dict[str, dict[str, Leaf]]  # item -> path -> leaf; some items may be absent
  segments: list[Segment]


def describe(
  config: TrainConfig,
  items: Mapping[str, Mapping[str, Leaf]],
  success_rate: float | None,
  segments: Sequence[Segment],
) -> dict[str, Any]:
  """Returns the record for a checkpoint as JSON data; see ``Record``."""
  record = {
    "schema_version": SCHEMA_VERSION,
    "config": json.loads(config_to_json(config)),
    "success_rate": None if success_rate is None else float(success_rate),
    "items": items,
    "segments": sorted(segments),
  }
  return record | {"crc32": _checksum(record)}


def describe_item(tree: Any, apart: Container[str]) -> dict[str, Leaf]:
  """Returns path -> leaf; those at the paths ``apart`` are in segments."""
  named = leaves.named(tree)
  crc32s = leaves.checksums(leaves.without(tree, apart))
  return {
    path: Leaf(leaves.kind(leaf), leaves.key_impl(leaf), crc32s.get(path))
    for path, leaf in named.items()
  }


def read(run_dir: Path, step: int) -> Record:
  """Returns the record of a checkpoint.

  Raises:
    DamagedError: The record is missing or differs from what was written.
    FileError: The record has another format.
  """
  return _read(folder(run_dir) / str(step) / _FILE, title(run_dir, step))


def used_segments(run_dir: Path) -> set[int] | None:
  """Returns the numbers of the segments of all intact checkpoints.

  They include those that are being written or were set aside. Returns None if a record
  may be intact but cannot be read, because of the file system or another format.
  """
  used = set()
  for path in run_dir.glob(f"*/*/{_FILE}"):
    try:
      used |= {segment.number for segment in _read(path, str(path)).segments}
    except DamagedError as error:
      cause = error.__context__
      if isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError):
        return None
    except FileError:
      return None
  return used


def _read(path: Path, name: str) -> Record:
  try:
    record = json.loads(text.read_text(path, _MAX_BYTES))
    version, crc32 = record["schema_version"], record.pop("crc32", None)
    whole = crc32 == _checksum(record)
    if version not in _READABLE and (whole or crc32 is None):
      raise FileError(
        f"{name} has format {str(version)[:20]}; this code reads up to {SCHEMA_VERSION}"
      )
    if not whole:
      raise DamagedError(f"{name} is damaged: its record is not what was saved")
    items = {
      item: {path: Leaf(*leaf) for path, leaf in tree.items()}
      for item, tree in record["items"].items()
    }
    rate = record["success_rate"]
    return Record(
      config=record["config"],
      success_rate=None if rate is None else float(rate),
      items=items,
      segments=[_segment(*fields) for fields in record.get("segments", ())],
    )
  except UserError:
    raise
  except _MALFORMED as error:
    raise DamagedError(f"{name} cannot be read: {one_line(error)}") from None


def read_all(run_dir: Path) -> dict[int, Record]:
  """Returns step -> record, ascending, of each readable checkpoint of a run.

  Reads again if a run that is training made or removed a checkpoint meanwhile.
  """
  while True:
    records, listed = {}, steps(run_dir)
    for step in listed:
      try:
        records[step] = read(run_dir, step)
      except UserError:  # Reported when this checkpoint is requested.
        continue
    if steps(run_dir) == listed:
      return records


def steps(run_dir: Path) -> list[int]:
  """Returns the steps of the complete checkpoints of a run, ascending."""
  # One call, because a run that is training may remove what is looked at later. Orbax
  # renames a checkpoint to its step when it is complete.
  try:
    names = os.listdir(folder(run_dir))
  except FileNotFoundError:
    return []
  return sorted(int(name) for name in names if name.isdecimal())


def folder(run_dir: Path) -> Path:
  """Returns the folder of the checkpoints of a run."""
  return run_dir.absolute() / "checkpoints"


def title(run_dir: Path, step: int) -> str:
  """Returns the name of a checkpoint for messages."""
  return f"checkpoint {step} of {str(run_dir)!r}"


def best(rates: Mapping[int, float | None]) -> int | None:
  """Returns the newest step with the highest rate; None if there is no rate."""
  known = {step: rate for step, rate in rates.items() if rate is not None}
  return max(known, key=lambda step: (known[step], step), default=None)


def newest_until(last: int, steps: Iterable[int]) -> int | None:
  """Returns the largest of ``steps`` up to ``last``; None if there is none."""
  return max((step for step in steps if step <= last), default=None)


def _segment(
  ring: str, start: int, stop: int, number: int, crc32s: dict[str, int]
) -> Segment:
  """Returns a segment whose indices and number are what they claim to be."""
  start, stop, number = map(operator.index, (start, stop, number))
  if not 0 <= start < stop:
    raise ValueError(f"a segment is from {start} to {stop}")
  return Segment(str(ring), start, stop, number, dict(crc32s))


def _checksum(record: dict[str, Any]) -> int:
  return zlib.crc32(json.dumps(record, sort_keys=True).encode())
