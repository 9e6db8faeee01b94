"""What every checkpoint says of itself: settings, success rate, and each leaf.

Read before the arrays are, so that a checkpoint that is wrong, damaged or too large is
refused by name before memory is taken for it. Orbax itself would cast a leaf of another
dtype without a word and does not notice a flipped bit; hence the checksums, of the
leaves and of the record.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import json
from pathlib import Path
from typing import Any, NamedTuple
import zlib

from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FileError, UserError, one_line
from apnpql_jax.runs import leaves, text

SCHEMA_VERSION = 2
"""Raised whenever what the code expects in a checkpoint changes."""

_MAX_BYTES = 16 << 20
"""A record has some hundred bytes per leaf; a longer file is none of ours."""


class DamagedError(FileError):
  """A checkpoint that is not as it was written; an older one may be."""


class Leaf(NamedTuple):
  """One array of a checkpoint."""

  kind: str
  """dtype and shape, such as ``uint8[4, 72, 96, 3]``."""

  key_impl: str | None
  """Name of its generator, if it is a typed PRNG key."""

  crc32: int
  """Of its bytes."""


class Record(NamedTuple):
  """What ``describe`` wrote and ``read`` verified."""

  config: dict[str, Any]
  success_rate: float | None
  items: dict[str, dict[str, Leaf]]
  """Item -> path -> leaf; a checkpoint may lack items that older ones hold."""


def describe(
  config: TrainConfig, items: Mapping[str, Any], success_rate: float | None
) -> dict[str, Any]:
  """The record of a checkpoint of ``items`` (name -> pytree), as JSON can hold it."""
  record = {
    "schema_version": SCHEMA_VERSION,
    "config": json.loads(config_to_json(config)),
    "success_rate": None if success_rate is None else float(success_rate),
    "items": {name: _describe_leaves(tree) for name, tree in items.items()},
  }
  return record | {"crc32": _checksum(record)}


def read(run_dir: Path, step: int) -> Record:
  """The record of a checkpoint.

  Raises:
    DamagedError: it is not there or not as it was written.
    FileError: it has another format.
  """
  path = folder(run_dir) / str(step) / "meta" / "metadata"
  name = title(run_dir, step)
  try:
    record = json.loads(text.read_text(path, _MAX_BYTES))
    version, crc32 = record["schema_version"], record.pop("crc32", None)
    whole = crc32 == _checksum(record)
    if version != SCHEMA_VERSION and (whole or crc32 is None):
      raise FileError(
        f"{name} has format {str(version)[:20]}; this code reads {SCHEMA_VERSION}"
      )
    if not whole:
      raise DamagedError(f"{name} is damaged: its record is not what was saved")
    items = {
      item: {path: Leaf(*leaf) for path, leaf in tree.items()}
      for item, tree in record["items"].items()
    }
    rate = record["success_rate"]
    return Record(record["config"], None if rate is None else float(rate), items)
  except UserError:
    raise
  except (
    OSError,
    ValueError,
    RecursionError,
    LookupError,
    TypeError,
    AttributeError,
  ) as e:
    raise DamagedError(f"{name} cannot be read: {one_line(e)}") from None


def read_all(run_dir: Path) -> dict[int, Record]:
  """Step -> record of every checkpoint of a run that can be read, ascending."""
  records = {}
  for step in steps(run_dir):
    try:
      records[step] = read(run_dir, step)
    except UserError:  # Named where somebody asks for it.
      continue
  return records


def steps(run_dir: Path) -> list[int]:
  """Steps of the complete checkpoints of a run, ascending."""
  from orbax.checkpoint import utils

  return sorted(utils.checkpoint_steps(folder(run_dir)))


def folder(run_dir: Path) -> Path:
  """Where the checkpoints of a run lie."""
  return run_dir.absolute() / "checkpoints"


def title(run_dir: Path, step: int) -> str:
  """How messages name a checkpoint."""
  return f"checkpoint {step} of {str(run_dir)!r}"


def best(rates: Mapping[int, float | None]) -> int | None:
  """Step of the highest rate, the newest of equals; None if there is none."""
  known = {step: rate for step, rate in rates.items() if rate is not None}
  return max(known, key=lambda step: (known[step], step), default=None)


def newest_until(last: int, steps: Iterable[int]) -> int | None:
  """The largest of ``steps`` up to ``last``; None if there is none."""
  return max((step for step in steps if step <= last), default=None)


def check_kinds(name: str, saved: Mapping[str, Leaf], example: Any) -> None:
  """Refuses leaves of another name, dtype or shape than those of ``example``.

  Raises:
    FileError: names the first leaf that differs.
  """
  wanted = leaves.describe(example)
  for path in sorted(saved.keys() | wanted.keys()):
    held = saved[path].kind if path in saved else "nothing"
    expected = wanted.get(path, "nothing")
    if held != expected:
      raise FileError(f"{name} holds {held} at {path}, where {expected} is expected")


def check_bits(name: str, saved: Mapping[str, Leaf], tree: Any) -> None:
  """Compares what was read with what was saved.

  Raises:
    DamagedError: names the first leaf that differs.
  """
  for path, crc32 in leaves.checksums(tree).items():
    if crc32 != saved[path].crc32:
      raise DamagedError(f"{name} is damaged: {path} is not what was saved")


def _describe_leaves(tree: Any) -> dict[str, Leaf]:
  impls, crc32s = leaves.key_impls(tree), leaves.checksums(tree)
  return {
    path: Leaf(kind, impls.get(path), crc32s[path])
    for path, kind in leaves.describe(tree).items()
  }


def _checksum(record: dict[str, Any]) -> int:
  return zlib.crc32(json.dumps(record, sort_keys=True).encode())
