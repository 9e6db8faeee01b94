"""Writes the checkpoints of a run in the background, with Orbax, and sorts them out.

A checkpoint consists of named items, so that the replay, by far the largest, may be
saved less often than the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import shutil
import time
from typing import Any

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import one_line
from apnpql_jax.runs import checkpoint_record, leaves
from apnpql_jax.runs.checkpoint_record import best, newest_until

_CHUNK_BYTES = 16 << 20
"""Unit of compression: a replay as one chunk took one core twice as long."""


class SaveError(OSError):
  """A checkpoint could not be written; those before it are as they were."""


class CheckpointWriter:
  """Saves the checkpoints of one run and deletes those no longer wanted.

  Use as a context manager: leaving it waits until the last save is on disk, unless that
  has failed. A checkpoint becomes visible only once it is complete.
  """

  def __init__(
    self,
    run_dir: Path,
    config: TrainConfig,
    *,
    keep: int,
    keep_best: bool = True,
  ):
    """Opens the run for writing.

    Args:
      run_dir: the run folder.
      config: stored beside every state.
      keep: newest checkpoints kept, with the older ones that their items lie in.
      keep_best: keep the one of highest success rate too (the newest of equals).
    """
    import orbax.checkpoint as ocp

    self._run_dir, self._config = run_dir, config
    self._keep = _KeepNewestAndBest(run_dir, keep, keep_best=keep_best)
    options = ocp.CheckpointManagerOptions(
      preservation_policy=self._keep, cleanup_tmp_directories=True
    )
    self._manager = ocp.CheckpointManager(
      checkpoint_record.folder(run_dir), options=options
    )
    self._saving: tuple[int, float] | None = None

  @property
  def empty(self) -> bool:
    """No checkpoint has been saved."""
    return not self._manager.all_steps()

  def save(
    self, step: int, items: Mapping[str, Any], *, success_rate: float | None = None
  ) -> bool:
    """Starts writing ``items``; they may be donated as soon as this returns.

    On a CPU, donated buffers that are still being read are replaced by new ones, so
    that memory for a second state is needed. Waits for an earlier save first.

    Args:
      step: environment steps done.
      items: name -> pytree of arrays, typed PRNG keys included.
      success_rate: what decides which checkpoint is best; None if not evaluated.

    Returns:
      False if this step had been saved before; nothing is written then.

    Raises:
      SaveError: this save could not be started, or the one before it failed.
    """
    import orbax.checkpoint as ocp

    self.wait()
    if step in self._manager.all_steps():
      return False
    self._saving = step, time.monotonic()
    record = checkpoint_record.describe(self._config, items, success_rate)
    parts = {name: _save_args(leaves.to_plain(tree)) for name, tree in items.items()}
    parts["meta"] = ocp.args.JsonSave(record)
    self._keep.note(step, success_rate, set(items))
    try:
      return self._manager.save(step, args=ocp.args.Composite(**parts), force=True)
    except Exception as error:
      raise self._failed(error) from error

  def finished(self, *, wait: bool = False) -> dict[str, float]:
    """Seconds and MiB of the save that has ended since the last call; else empty.

    Args:
      wait: until a save under way has ended.

    Raises:
      SaveError: it failed.
    """
    if self._saving is None or not wait and self._manager.is_saving_in_progress():
      return {}
    step, began = self._saving
    self.wait()
    files = (checkpoint_record.folder(self._run_dir) / str(step)).rglob("*")
    size = sum(path.stat().st_size for path in files if path.is_file())
    seconds = time.monotonic() - began
    return {"checkpoint/wall_s": seconds, "checkpoint/mib": size / 2**20}

  def wait(self) -> None:
    """Returns when everything saved is on disk.

    Raises:
      SaveError: it is not.
    """
    try:
      self._manager.wait_until_finished()
    except Exception as error:
      raise self._failed(error) from error
    self._saving = None

  def close(self) -> None:
    """Waits as ``wait`` does, then lets go of the run.

    Not if that fails: threads of a save that failed half-way can wait for each other
    for minutes.
    """
    self.wait()
    self._manager.close()

  def __enter__(self) -> CheckpointWriter:
    return self

  def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
    if kind is None or not issubclass(kind, SaveError):
      self.close()

  def _failed(self, error: Exception) -> SaveError:
    """Removes what a failed save left, which may be what fills the disk."""
    step, _ = self._saving or (None, 0.0)
    self._saving = None
    for part in checkpoint_record.folder(self._run_dir).glob(f"{step}.*-tmp*"):
      shutil.rmtree(part, ignore_errors=True)
    return SaveError(f"checkpoint {step} could not be saved: {_cause(error)}")


class _KeepNewestAndBest:
  """Orbax policy of what to keep; its own forget the metrics of earlier processes."""

  def __init__(self, run_dir: Path, keep: int, *, keep_best: bool):
    self._keep, self._keep_best = keep, keep_best
    self._rates: dict[int, float | None] = {}
    self._items: dict[int, set[str]] = {}
    for step, record in checkpoint_record.read_all(run_dir).items():
      self.note(step, record.success_rate, set(record.items))

  def note(self, step: int, success_rate: float | None, items: set[str]) -> None:
    self._rates[step], self._items[step] = success_rate, items

  def should_preserve(self, checkpoints: Sequence[Any], **_: Any) -> list[bool]:
    steps = sorted(info.step for info in checkpoints)
    newest = steps[-self._keep :]
    kept = set(newest)
    for name in set().union(*self._items.values()):
      holding = [step for step in steps if name in self._items.get(step, ())]
      kept |= {newest_until(step, holding) for step in newest}
    if self._keep_best:
      kept.add(best({step: self._rates.get(step) for step in steps}))
    return [info.step in kept for info in checkpoints]


def _save_args(plain: Any) -> Any:
  import jax
  import orbax.checkpoint as ocp

  chunked = jax.tree.map(lambda _: ocp.SaveArgs(chunk_byte_size=_CHUNK_BYTES), plain)
  return ocp.args.StandardSave(plain, save_args=chunked)


def _cause(error: Exception) -> str:
  """What the file system said, without the names of temporary files around it."""
  text = one_line(error)
  return text.rpartition(": ")[2] if "os_error_code" in text else text
