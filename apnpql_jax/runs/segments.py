"""Segments: parts of rings that are written once and shared by checkpoints.

A ring changes only where a chunk is appended, so a checkpoint writes only the parts
that have changed since the one before. Parts are written one after the other while
training continues, each from a copy. This bounds the memory that a checkpoint takes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
import functools
import math
from pathlib import Path
import shutil
from typing import Any, NamedTuple

from flax import traverse_util
import jax
from jax.experimental import multihost_utils
import numpy as np

from apnpql_jax import devices
from apnpql_jax.runs import leaves

PART_BYTES: int = 128 << 20
"""Size of a part over all devices; the copy of one is in memory at a time."""

_CHUNK_BYTES = 16 << 20
"""Unit of compression; an array in one chunk keeps a core busy twice as long."""


class Ring(NamedTuple):
  """Arrays that change only at the indices of the chunk that is appended."""

  arrays: dict[str, Any]  # item/path -> array [length, ...]
  cursor: int  # next index to write
  added: int  # indices written since the run began, counting overwritten ones
  chunk: int  # indices written at a time; 0 if the ring never changes


class Segment(NamedTuple):
  """One part of a ring on disk."""

  ring: str  # name of the ring
  start: int  # first index
  stop: int  # index after the last one
  number: int  # name of its folder
  crc32s: dict[str, int]  # item/path -> CRC-32 of array[start:stop]


class _Part(NamedTuple):
  """A part that is not written yet."""

  deadline: float  # value of ``Ring.added`` beyond which appending changes the part
  ring: str
  start: int
  stop: int


def folder(run_dir: Path) -> Path:
  """Returns the folder of the segments of a run."""
  return run_dir.absolute() / "segments"


def delete_unused(run_dir: Path, used: Iterable[int]) -> None:
  """Deletes all segments but ``used``, and what an interrupted write has left."""
  names = set(map(str, used))
  for path in folder(run_dir).glob("*"):
    if path.name not in names:
      shutil.rmtree(path, ignore_errors=True)


class SegmentWriter:
  """Writer of the segments of one run."""

  def __init__(self, run_dir: Path, rings: Mapping[str, Ring], held: Iterable[Segment]):
    """Opens the run for writing; ``rings`` hold what ``held`` has on disk."""
    import orbax.checkpoint as ocp

    self._folder = folder(run_dir)
    self._held = {segment[:3]: segment for segment in held}
    self._added = {name: ring.added for name, ring in rings.items()}
    names = [path.name for path in self._folder.glob("*")]
    last = max((int(name) for name in names if name.isdigit()), default=0)
    # Other processes may see another listing of a shared file system.
    self._last = int(multihost_utils.broadcast_one_to_all(np.int32(last)))
    self._parts: list[_Part] = []
    self._saver = ocp.StandardCheckpointer()
    self._pool = ThreadPoolExecutor(1)
    self._writing: Future[None] | None = None
    self.segments: list[Segment] = []
    """Segments that make up the rings of ``begin``, once ``proceed`` returns True."""
    self.written: list[Path] = []
    """Folders of the segments written since ``begin``."""

  def begin(self, rings: Mapping[str, Ring]) -> None:
    """Plans to write the changed parts, first those that will change again soonest."""
    self.segments, self.written, self._parts = [], [], []
    for name, ring in rings.items():
      new = ring.added - self._added.get(name, 0)
      self._added[name] = ring.added
      cursor, length = ring.cursor, len(next(iter(ring.arrays.values())))
      for start, stop in _bounds(ring, length):
        held = self._held.get((name, start, stop))
        # Age of the newest index in it, and indices to append until it changes.
        age = 0 if start < cursor <= stop else (cursor - stop) % length
        room = 0 if start < cursor < stop else (start - cursor) % length
        if age < (new if held else ring.added):
          deadline = ring.added + room if ring.chunk else math.inf
          self._parts.append(_Part(deadline, name, start, stop))
        elif held:
          self.segments.append(held)
    self._parts.sort(key=lambda part: part.deadline - rings[part.ring].added)

  def proceed(self, rings: Mapping[str, Ring], *, wait: bool) -> bool:
    """Writes the next part if the one before is on disk; returns whether all are.

    Must be called after each append, since a part must be copied before it changes.

    Args:
      rings: The rings as they are now.
      wait: Wait until all parts are written.
    """
    while self._writing or self._parts:
      if self._writing:
        urgent = wait or self._parts and self._is_urgent(self._parts[0], rings)
        if not urgent and devices.any_process(not self._writing.done()):
          return False
        self._writing.result()
        self._writing = None
      if self._parts:
        self._write(self._parts.pop(0), rings)
    return True

  def close(self) -> None:
    """Releases the threads."""
    self._pool.shutdown()
    self._saver.close()

  def _is_urgent(self, part: _Part, rings: Mapping[str, Ring]) -> bool:
    ring = rings[part.ring]
    return ring.added + ring.chunk > part.deadline

  def _write(self, part: _Part, rings: Mapping[str, Ring]) -> None:
    """Copies a part and starts writing it."""
    _, name, start, stop = part
    arrays = _cut(rings[name].arrays, start, stop - start)
    self._last += 1
    path = self._folder / str(self._last)
    tree = to_tree(arrays)
    crc32s = leaves.checksums(tree)
    self._saver.save(path, tree, save_args=chunked(tree))
    self._writing = self._pool.submit(self._saver.wait_until_finished)
    segment = Segment(name, start, stop, self._last, crc32s)
    self._held[name, start, stop] = segment
    self.segments.append(segment)
    self.written.append(path)


def _bounds(ring: Ring, length: int) -> list[tuple[int, int]]:
  """Returns start and stop of each part."""
  size = sum(array.nbytes for array in ring.arrays.values())
  rows = math.ceil(length / max(1, math.ceil(size / PART_BYTES)))
  return [(start, min(start + rows, length)) for start in range(0, length, rows)]


def chunked(tree: Any) -> Any:
  """Returns Orbax's arguments for saving a tree."""
  import orbax.checkpoint as ocp

  return jax.tree.map(lambda _: ocp.SaveArgs(chunk_byte_size=_CHUNK_BYTES), tree)


def to_tree(arrays: Mapping[str, Any]) -> dict[str, Any]:
  """Returns the arrays of a segment (path -> array) as Orbax stores them."""
  return traverse_util.unflatten_dict(arrays, sep="/")


@functools.partial(jax.jit, donate_argnums=0)
def put(rings: dict[str, Any], part: dict[str, Any], start: int) -> dict[str, Any]:
  """Writes a part into the arrays of a ring in place, from index ``start`` on."""
  return {
    path: jax.lax.dynamic_update_slice_in_dim(ring, part[path], start, axis=0)
    for path, ring in rings.items()
  }


@functools.partial(jax.jit, static_argnames="rows")
def _cut(rings: dict[str, Any], start: int, rows: int) -> dict[str, Any]:
  return jax.tree.map(
    lambda ring: jax.lax.dynamic_slice_in_dim(ring, start, rows), rings
  )
