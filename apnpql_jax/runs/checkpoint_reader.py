"""Checkpoint reading: the newest one that is intact and belongs to the run.

Items of a checkpoint are read one by one, because an evaluation needs the learner
alone. Each is verified against the record of the checkpoint, see ``checkpoint_record``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
import logging
from pathlib import Path
from typing import Any, NamedTuple

import jax

from apnpql_jax.config.files import config_from_json
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FileError, UserError, one_line
from apnpql_jax.runs import checkpoint_record, leaves, segments
from apnpql_jax.runs.checkpoint_record import DamagedError, best, newest_until, title
from apnpql_jax.runs.run_folder import fixed_diff
from apnpql_jax.runs.segments import Segment

all_steps = checkpoint_record.steps


class Restored(NamedTuple):
  """Result of ``restore``."""

  step: int
  items: dict[str, Any]  # item -> pytree, as requested
  steps: dict[str, int]  # item -> step of the checkpoint it is from, at most ``step``
  damaged: list[str]  # a line for each newer checkpoint that could not be used


def latest_step(run_dir: Path) -> int | None:
  """Returns the step of the newest complete checkpoint; None if there is none."""
  return max(all_steps(run_dir), default=None)


def best_step(run_dir: Path) -> int | None:
  """Returns the step with the highest success rate; None if none was evaluated.

  Of equal rates the newest wins.
  """
  records = checkpoint_record.read_all(run_dir)
  return best({step: record.success_rate for step, record in records.items()})


def restore(
  run_dir: Path,
  step: int | None,
  examples: Mapping[str, Any],
  *,
  config: TrainConfig | None = None,
) -> Restored:
  """Restores items of a checkpoint with the exact bits that were saved.

  An item that the checkpoint lacks comes from the newest earlier one that holds it.
  Without ``examples``, only rejects checkpoints that cannot be restored, which needs
  nothing but their records.

  Args:
    run_dir: The run folder.
    step: The checkpoint, without fallback; None selects the newest readable one.
    examples: Item -> pytree of the same structure, of arrays or, to save the memory of
      a second state, ShapeDtypeStructs.
    config: The configuration that the checkpoint must have, except for settings that a
      resumed run may change; not checked if None.

  Raises:
    FileError: There is no such checkpoint, it belongs to another configuration or
      format, its leaves differ from the example, or its files cannot be read.
  """
  damaged: dict[int, str] = {}
  # Listed again each time: a run that is training makes and removes checkpoints.
  while left := [x for x in _candidates(run_dir, step) if x not in damaged]:
    candidate = left[0]
    try:
      record = checkpoint_record.read(run_dir, candidate)
      if config is not None:
        _check_config(title(run_dir, candidate), record.config, config)
      steps = {name: _step_with(run_dir, candidate, name) for name in examples}
      items = {
        name: _restore_item(run_dir, steps[name], name, example)
        for name, example in examples.items()
      }
      newer = [line for other, line in damaged.items() if other > candidate]
      return Restored(candidate, items, steps, newer)
    except DamagedError as error:
      damaged[candidate] = str(error)
  raise DamagedError("; ".join(damaged.values()))


def _candidates(run_dir: Path, step: int | None) -> list[int]:
  """Returns the requested step, or all steps, newest first."""
  steps = all_steps(run_dir)
  if not steps:
    raise FileError(f"{str(run_dir)!r} has no checkpoint")
  if step is None:
    return steps[::-1]
  if step not in steps:
    valid = ", ".join(map(str, steps))
    raise FileError(f"{str(run_dir)!r} has no checkpoint {step}; choose from {valid}")
  return [step]


def _check_config(name: str, saved: Any, wanted: TrainConfig) -> None:
  try:
    diff = fixed_diff(config_from_json(json.dumps(saved)), wanted)
  except UserError as error:
    raise FileError(f"{name}: {error}") from None
  if diff:
    raise FileError(f"{name} belongs to other settings: {diff}")


def _step_with(run_dir: Path, last: int, item: str) -> int:
  records = checkpoint_record.read_all(run_dir)
  holding = [step for step, record in records.items() if item in record.items]
  step = newest_until(last, holding)
  if step is None:
    name = title(run_dir, last)
    raise DamagedError(f"neither {name} nor an earlier checkpoint has the {item}")
  return step


def _restore_item(run_dir: Path, step: int, item: str, example: Any) -> Any:
  name = title(run_dir, step)
  record = checkpoint_record.read(run_dir, step)
  saved = record.items[item]
  wanted = {path: leaves.kind(leaf) for path, leaf in leaves.named(example).items()}
  for path in sorted(saved.keys() | wanted.keys()):
    held = saved[path].kind if path in saved else "nothing"
    expected = wanted.get(path, "nothing")
    if held != expected:
      raise FileError(f"{name} holds {held} at {path}, where {expected} is expected")
  apart = {path for path, leaf in saved.items() if leaf.crc32 is None}
  folder = checkpoint_record.folder(run_dir) / str(step) / item
  crc32s = {path: leaf.crc32 for path, leaf in saved.items()}
  tree = _read(folder, leaves.without(example, apart), crc32s, name)
  impls = {path: leaf.key_impl for path, leaf in saved.items() if leaf.key_impl}
  try:
    tree = leaves.to_typed(tree, impls, example)  # With zeros for arrays apart.
  except (TypeError, ValueError) as error:
    raise DamagedError(f"{name} cannot be read: {one_line(error)}") from None
  arrays = leaves.named(tree)
  rings = {f"{item}/{path}": arrays.pop(path) for path in apart}
  del tree  # The rings are donated.
  rings = _fill(run_dir, rings, record.segments, name)
  arrays |= {path: rings[f"{item}/{path}"] for path in apart}
  return leaves.fill(example, arrays)


def _fill(
  run_dir: Path, rings: dict[str, Any], held: Sequence[Segment], name: str
) -> dict[str, Any]:
  """Returns the rings with their segments written into them, in place."""
  found = set()
  for segment in held:
    paths = segment.crc32s.keys()
    if not paths & rings.keys():
      continue
    rows = segment.stop - segment.start
    if not paths <= rings.keys() or segment.stop > min(len(rings[x]) for x in paths):
      raise DamagedError(f"{name} cannot be read: a segment is not within its ring")
    target = {path: rings.pop(path) for path in paths}
    shapes = {
      path: jax.ShapeDtypeStruct((rows, *x.shape[1:]), x.dtype, sharding=x.sharding)
      for path, x in target.items()
    }
    folder = segments.folder(run_dir) / str(segment.number)
    part = _read(folder, segments.to_tree(shapes), segment.crc32s, name)
    rings |= segments.put(target, leaves.named(part), segment.start)
    found |= paths
  if missing := rings.keys() - found:
    raise DamagedError(f"{name} cannot be read: no segment holds {min(missing)}")
  return rings


def _read(folder: Path, example: Any, crc32s: Mapping[str, int | None], name: str):
  """Returns a tree of arrays without typed keys, compared with its checksums."""
  import orbax.checkpoint as ocp

  try:
    with ocp.StandardCheckpointer() as reader:
      tree = reader.restore(folder, leaves.abstract(example))
  except (MemoryError, PermissionError):
    raise  # Not caused by the checkpoint.
  except Exception as error:  # Any error of Orbax or the file system.
    # Orbax's abandoned tasks would log pages of tracebacks.
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    raise DamagedError(f"{name} cannot be read: {one_line(error)}") from error
  for path, crc32 in leaves.checksums(tree).items():
    if crc32 != crc32s[path]:
      raise DamagedError(f"{name} is damaged: {path} is not what was saved")
  return tree
