"""Checkpoint writing in the background, with Orbax.

A checkpoint consists of named items, so that the replay, by far the largest, can be
saved less often than the rest. Its rings are in segments, see ``segments``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
import shutil
import time
from typing import Any

import jax
import jax.numpy as jnp

from apnpql_jax import devices
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import one_line
from apnpql_jax.runs import checkpoint_record, leaves, segments
from apnpql_jax.runs.checkpoint_record import best, newest_until
from apnpql_jax.runs.segments import Ring, SegmentWriter


class SaveError(OSError):
  """A failed save; earlier checkpoints are unchanged."""


class CheckpointWriter:
  """Writer of the checkpoints of one run, which deletes those no longer needed.

  Use as a context manager: leaving it waits until the last save is on disk, unless a
  save has failed. A checkpoint becomes visible only once it is complete.
  """

  def __init__(
    self,
    run_dir: Path,
    config: TrainConfig,
    *,
    keep: int,
    restored: Mapping[str, Ring] | None = None,
  ):
    """Opens the run for writing.

    Keeps the ``keep`` newest checkpoints, the older ones that hold items they lack, and
    the one with the highest success rate.

    Args:
      run_dir: The run folder.
      config: Settings of the run, stored with every checkpoint.
      keep: Number of newest checkpoints to keep.
      restored: The rings, if the newest checkpoints have what is in them.
    """
    import orbax.checkpoint as ocp

    self._run_dir, self._config = run_dir, config
    self._delete_unused()
    devices.barrier()
    records = checkpoint_record.read_all(run_dir).values() if restored else ()
    held = [segment for record in records for segment in record.segments]
    self._rings: Mapping[str, Ring] = restored or {}
    self._segments = SegmentWriter(run_dir, self._rings, held)
    self._policy = _KeepNewestAndBest(run_dir, keep)
    options = ocp.CheckpointManagerOptions(
      preservation_policy=self._policy, cleanup_tmp_directories=True
    )
    self._manager = ocp.CheckpointManager(
      checkpoint_record.folder(run_dir), options=options
    )
    self._saving: tuple[int, float] | None = None
    self._commit: Callable[[], None] | None = None
    """Starts writing the checkpoint once its segments are on disk."""

  @property
  def empty(self) -> bool:
    """Whether the run has no checkpoint."""
    return not self._manager.all_steps()

  def save(
    self,
    step: int,
    items: Mapping[str, Any],
    *,
    rings: Mapping[str, Ring] | None = None,
    success_rate: float | None = None,
  ) -> None:
    """Starts writing ``items``; they may be donated as soon as this returns.

    Waits for the previous save first. Does nothing if this step has already been saved.

    Args:
      step: Environment steps done.
      items: Name -> pytree of arrays, including typed PRNG keys.
      rings: Name -> arrays of the items that are written in segments. ``proceed`` must
        be called whenever they have changed.
      success_rate: Decides which checkpoint is the best; None if not evaluated.

    Raises:
      SaveError: This save cannot be started, or the previous one failed.
    """
    import orbax.checkpoint as ocp

    self.wait()
    if step in self._manager.all_steps():
      return
    self._rings = rings or {}
    self._saving = step, time.monotonic()
    self._segments.begin(self._rings)
    apart = {path for ring in self._rings.values() for path in ring.arrays}
    described, whole = {}, {}
    for name, tree in items.items():
      paths = {path.removeprefix(f"{name}/") for path in apart}
      described[name] = checkpoint_record.describe_item(tree, paths)
      whole[name] = leaves.without(tree, paths)
    copies = _copy(whole)
    self._policy.rates[step], self._policy.items[step] = success_rate, set(items)

    def commit() -> None:
      written = self._segments.segments
      record = checkpoint_record.describe(
        self._config, described, success_rate, written
      )
      parts: dict[str, Any] = {"meta": ocp.args.JsonSave(record)}
      for name, tree in copies.items():
        plain = leaves.to_plain(tree)
        args = segments.chunked(plain)
        parts[name] = ocp.args.StandardSave(plain, save_args=args)
      self._manager.save(step, args=ocp.args.Composite(**parts), force=True)

    self._commit = commit
    self._proceed(wait=False)

  def proceed(
    self, rings: Mapping[str, Ring] | None = None, *, wait: bool = False
  ) -> dict[str, float]:
    """Continues a save, and returns seconds and MiB of one that has ended, if any.

    Args:
      rings: The rings as they are now; None if they have not changed.
      wait: Wait for a save in progress.

    Raises:
      SaveError: The save failed.
    """
    if self._saving is None:
      return {}
    self._rings = self._rings if rings is None else rings
    self._proceed(wait=wait)
    if self._commit or not wait and self._manager.is_saving_in_progress():
      return {}
    step, began = self._saving
    self.wait()
    folders = [checkpoint_record.folder(self._run_dir) / str(step)]
    folders += self._segments.written
    files = [path for folder in folders for path in folder.rglob("*")]
    size = sum(path.stat().st_size for path in files if path.is_file())
    seconds = time.monotonic() - began
    return {"checkpoint/wall_s": seconds, "checkpoint/mib": size / 2**20}

  def _proceed(self, *, wait: bool) -> None:
    """Writes segments and, once all are on disk, starts writing the checkpoint."""
    try:
      if self._commit and self._segments.proceed(self._rings, wait=wait):
        commit, self._commit = self._commit, None
        commit()
    except Exception as error:
      raise _save_error(self._delete_failed(), error) from error

  def wait(self) -> None:
    """Waits until everything saved is on disk.

    Raises:
      SaveError: A save failed.
    """
    self._proceed(wait=True)
    try:
      self._manager.wait_until_finished()
    except Exception as error:
      raise _save_error(self._delete_failed(), error) from error
    if self._saving:
      self._saving = None
      self._delete_unused()

  def _delete_unused(self) -> None:
    if devices.is_primary():
      used = checkpoint_record.used_segments(self._run_dir)
      if used is not None:
        segments.delete_unused(self._run_dir, used)

  def close(self) -> None:
    """Waits as ``wait`` does, then releases Orbax's threads.

    After a failed save it leaves them alone, because they can block each other for
    minutes.
    """
    self.wait()
    self._segments.close()
    self._manager.close()

  def __enter__(self) -> CheckpointWriter:
    return self

  def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
    if kind is None or not issubclass(kind, SaveError):
      if kind is not None and self._commit:  # The rings may be gone.
        self._saving = self._commit = None
      self.close()

  def _delete_failed(self) -> int | None:
    """Deletes a failed save, which may fill the disk; returns its step."""
    step, _ = self._saving or (None, 0.0)
    self._saving = self._commit = None
    for part in checkpoint_record.folder(self._run_dir).glob(f"{step}.*-tmp*"):
      shutil.rmtree(part, ignore_errors=True)
    self._delete_unused()
    return step


def _save_error(step: int | None, cause: Exception) -> SaveError:
  """Returns the error of a failed save; leaves out the names of temporary files."""
  line = one_line(cause)
  if "os_error_code" in str(cause):
    line = " ".join(str(cause).split()).rpartition(": ")[2]
  return SaveError(f"checkpoint {step} could not be saved: {line}")


@jax.jit
def _copy(tree: Any) -> Any:
  return jax.tree.map(jnp.copy, tree)


class _KeepNewestAndBest:
  """Orbax policy that keeps the newest checkpoints, their items, and the best one.

  Orbax's own policies do not see items, and its BestN reads the rate from an item of
  its own instead of the record.
  """

  def __init__(self, run_dir: Path, keep: int):
    records = checkpoint_record.read_all(run_dir)
    self._keep = keep
    self.rates = {step: record.success_rate for step, record in records.items()}
    self.items = {step: set(record.items) for step, record in records.items()}

  def should_preserve(self, checkpoints: Sequence[Any], **_: Any) -> list[bool]:
    """Returns for each checkpoint whether to keep it; called by Orbax."""
    steps = sorted(info.step for info in checkpoints)
    newest = steps[-self._keep :]
    kept = {*newest, best({step: self.rates.get(step) for step in steps})}
    for name in set().union(*self.items.values()):
      holding = [step for step in steps if name in self.items.get(step, ())]
      kept |= {newest_until(step, holding) for step in newest}
    return [info.step in kept for info in checkpoints]
