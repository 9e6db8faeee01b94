"""Checkpoint reading: the newest one that is intact and belongs to the run.

Items of a checkpoint are read one by one, because an evaluation needs the learner
alone. Each is verified against the record of the checkpoint, see ``checkpoint_record``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import json
import logging
from pathlib import Path
from typing import Any, NamedTuple

import jax

from apnpql_jax.config.changes import fixed_diff
from apnpql_jax.config.files import config_from_json
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FileError, UserError, one_line
from apnpql_jax.runs import checkpoint_record, leaves, segments
from apnpql_jax.runs.checkpoint_record import (
  DamagedError,
  Record,
  best,
  newest_until,
  title,
)
from apnpql_jax.runs.segments import Segment

all_steps = checkpoint_record.steps


class Restored(NamedTuple):
  """Result of ``restore``."""

  step: int
  record: Record  # of the checkpoint
  items: dict[str, Any]  # item -> pytree, as requested
  steps: dict[str, int]  # item -> step of the checkpoint it is from, at most ``step``
  damaged: list[str]  # a line for each newer checkpoint that could not be used
  lost: list[Segment]  # that could not be read, and are zeros in the items


def latest_step(run_dir: Path) -> int | None:
  """Returns the step of the newest complete checkpoint; None if there is none."""
  return max(all_steps(run_dir), default=None)


def best_step(run_dir: Path) -> int:
  """Returns the step with the highest success rate; of equal rates the newest wins.

  Raises:
    FileError: No checkpoint was evaluated in the iteration that saved it.
  """
  records = checkpoint_record.read_all(run_dir)
  found = best({step: record.success_rate for step, record in records.items()})
  if found is None:
    raise FileError(
      f"no checkpoint of {str(run_dir)!r} has a success rate, because none was saved "
      "together with an evaluation; choose the newest or a step"
    )
  return found


def restore(
  run_dir: Path,
  step: int | None,
  examples: Mapping[str, Any] | Callable[[Any], Mapping[str, Any]],
  *,
  config: TrainConfig | None = None,
  partly: bool = False,
  without_segments: bool = False,
) -> Restored:
  """Restores items of a checkpoint with the exact bits that were saved.

  An item that the checkpoint lacks comes from the newest earlier one that holds it.
  With empty ``examples``, it reads only the records and rejects checkpoints that cannot
  be restored.

  Args:
    run_dir: The run folder.
    step: The checkpoint, without fallback; None selects the newest readable one.
    examples: Item -> pytree of the same structure, of arrays or, to save the memory of
      a second state, ShapeDtypeStructs. Or, with ``config``, a function that returns
      them, given the settings with which the checkpoint was saved.
    config: The configuration that the checkpoint must have, except for settings that a
      resumed run may change; not checked if None.
    partly: The pytrees are nested dicts of some arrays of the items, none of which is
      in segments. The others are not read.
    without_segments: If no checkpoint is intact, return the newest one in which only
      segments are damaged.

  Raises:
    FileError: There is no such checkpoint, it belongs to another configuration or
      format, its leaves differ from the example, or its files cannot be read.
  """
  damaged: dict[int, str] = {}

  def first(*, tolerant: bool = False) -> Restored | None:
    tried: set[int] = set()
    # Listed again each time: a run that is training makes and removes checkpoints.
    while left := [x for x in _candidates(run_dir, step) if x not in tried]:
      tried.add(left[0])
      try:
        reader = _Reader(run_dir, left[0], partly=partly, tolerant=tolerant)
        found = reader.restore(examples, config)
        newer = [line for other, line in damaged.items() if other > left[0]]
        return found._replace(damaged=newer)
      except DamagedError as error:
        damaged[left[0]] = str(error)
    return None

  found = first()
  if found is None and without_segments:
    found = first(tolerant=True)
  if found is None:
    raise DamagedError("; ".join(damaged.values()))
  return found


class _Reader:
  """Reader of one checkpoint; raises ``DamagedError`` for what it cannot read.

  If ``tolerant``, it collects segments that it cannot read instead.
  """

  def __init__(self, run_dir: Path, step: int, *, partly: bool, tolerant: bool):
    self._run_dir, self._step = run_dir, step
    self._partly, self._tolerant = partly, tolerant
    self._lost: list[Segment] = []

  def restore(
    self,
    examples: Mapping[str, Any] | Callable[[Any], Mapping[str, Any]],
    config: TrainConfig | None,
  ) -> Restored:
    """Returns the items; the arguments are those of the function ``restore``."""
    step, record = self._step, checkpoint_record.read(self._run_dir, self._step)
    saved = config and _config(title(self._run_dir, step), record.config, config)
    wanted = examples if isinstance(examples, Mapping) else examples(saved)
    steps = {
      name: step if name in record.items else _step_with(self._run_dir, step, name)
      for name in wanted
    }
    items = {
      name: self._item(name, steps[name], example) for name, example in wanted.items()
    }
    return Restored(step, record, items, steps, [], self._lost)

  def _item(self, item: str, step: int, example: Any) -> Any:
    """Returns an item from the checkpoint ``step``, which holds it."""
    name = title(self._run_dir, step)
    record = checkpoint_record.read(self._run_dir, step)
    saved = record.items[item]
    wanted = {path: leaves.kind(leaf) for path, leaf in leaves.named(example).items()}
    if self._partly:
      saved = {path: saved[path] for path in wanted if path in saved}
    for path in sorted(saved.keys() | wanted.keys()):
      held = saved[path].kind if path in saved else "nothing"
      expected = wanted.get(path, "nothing")
      if held != expected:
        raise FileError(f"{name} holds {held} at {path}, where {expected} is expected")
    apart = {path for path, leaf in saved.items() if leaf.crc32 is None}
    folder = checkpoint_record.folder(self._run_dir) / str(step) / item
    crc32s = {path: leaf.crc32 for path, leaf in saved.items()}
    tree = _read(folder, leaves.without(example, apart), crc32s, name, self._partly)
    impls = {path: leaf.key_impl for path, leaf in saved.items() if leaf.key_impl}
    try:
      tree = leaves.to_typed(tree, impls, example)  # With zeros for arrays apart.
    except (TypeError, ValueError) as error:
      raise DamagedError(f"{name} cannot be read: {one_line(error)}") from None
    arrays = leaves.named(tree)
    rings = {f"{item}/{path}": arrays.pop(path) for path in apart}
    del tree  # The rings are donated.
    rings = self._filled(rings, record.segments, name)
    arrays |= {path: rings[f"{item}/{path}"] for path in apart}
    return leaves.fill(example, arrays)

  def _filled(
    self, rings: dict[str, Any], held: Sequence[Segment], name: str
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
      found |= paths
      shapes = {
        path: jax.ShapeDtypeStruct((rows, *x.shape[1:]), x.dtype, sharding=x.sharding)
        for path, x in rings.items()
        if path in paths
      }
      folder = segments.folder(self._run_dir) / str(segment.number)
      try:
        part = _read(folder, segments.to_tree(shapes), segment.crc32s, name)
      except DamagedError:
        if not self._tolerant:
          raise
        self._lost.append(segment)
        continue
      target = {path: rings.pop(path) for path in paths}
      rings |= segments.put(target, leaves.named(part), segment.start)
    if missing := rings.keys() - found:
      raise DamagedError(f"{name} cannot be read: no segment holds {min(missing)}")
    return rings


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


def _config(name: str, record: Any, wanted: TrainConfig) -> TrainConfig:
  """Returns the settings of a checkpoint, which must be the wanted ones."""
  try:
    saved = config_from_json(json.dumps(record))
  except UserError as error:
    raise FileError(f"{name}: {error}") from None
  if diff := fixed_diff(saved, wanted):
    raise FileError(f"{name} belongs to other settings: {diff}")
  return saved


def _step_with(run_dir: Path, last: int, item: str) -> int:
  records = checkpoint_record.read_all(run_dir)
  holding = [step for step, record in records.items() if item in record.items]
  step = newest_until(last, holding)
  if step is None:
    name = title(run_dir, last)
    raise DamagedError(f"neither {name} nor an earlier checkpoint has the {item}")
  return step


def _read(
  folder: Path,
  example: Any,
  crc32s: Mapping[str, int | None],
  name: str,
  partly: bool = False,
) -> Any:
  """Returns a tree of arrays without typed keys, compared with its checksums."""
  import orbax.checkpoint as ocp

  wanted = leaves.abstract(example)
  try:
    if partly:
      kinds = ocp.checkpoint_utils.construct_restore_args(wanted)
      with ocp.PyTreeCheckpointer() as reader:
        tree = reader.restore(
          folder, ocp.args.PyTreeRestore(wanted, kinds, partial_restore=True)
        )
    else:
      with ocp.StandardCheckpointer() as reader:
        tree = reader.restore(folder, wanted)
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
