"""Checkpoint writing in the background, with Orbax.

A checkpoint consists of named items, so that the replay, by far the largest, can be
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
"""Unit of compression; a replay in one chunk keeps a core busy twice as long."""


class SaveError(OSError):
  """A failed save; earlier checkpoints are unchanged."""


class CheckpointWriter:
  """Writer of the checkpoints of one run, which deletes those no longer needed.

  Use as a context manager: leaving it waits until the last save is on disk, unless a
  save has failed. A checkpoint becomes visible only once it is complete.
  """

  def __init__(self, run_dir: Path, config: TrainConfig, *, keep: int):
    """Opens the run for writing; ``config`` is stored with every checkpoint.

    Keeps the ``keep`` newest checkpoints, the older ones that hold items they lack, and
    the one with the highest success rate.
    """
    import orbax.checkpoint as ocp

    self._run_dir, self._config = run_dir, config
    self._policy = _KeepNewestAndBest(run_dir, keep)
    options = ocp.CheckpointManagerOptions(
      preservation_policy=self._policy, cleanup_tmp_directories=True
    )
    self._manager = ocp.CheckpointManager(
      checkpoint_record.folder(run_dir), options=options
    )
    self._saving: tuple[int, float] | None = None

  @property
  def empty(self) -> bool:
    """Whether the run has no checkpoint."""
    return not self._manager.all_steps()

  def save(
    self, step: int, items: Mapping[str, Any], *, success_rate: float | None = None
  ) -> None:
    """Starts writing ``items``; they may be donated as soon as this returns.

    Waits for the previous save first. Does nothing if this step has already been saved.
    On a CPU, JAX replaces donated buffers that are still being read, which takes memory
    for a second state.

    Args:
      step: Environment steps done.
      items: Name -> pytree of arrays, including typed PRNG keys.
      success_rate: Decides which checkpoint is the best; None if not evaluated.

    Raises:
      SaveError: This save cannot be started, or the previous one failed.
    """
    import jax
    import orbax.checkpoint as ocp

    self.wait()
    if step in self._manager.all_steps():
      return
    self._saving = step, time.monotonic()
    record = checkpoint_record.describe(self._config, items, success_rate)
    parts: dict[str, Any] = {"meta": ocp.args.JsonSave(record)}
    chunked = ocp.SaveArgs(chunk_byte_size=_CHUNK_BYTES)
    for name, tree in items.items():
      plain = leaves.to_plain(tree)
      args = jax.tree.map(lambda _: chunked, plain)
      parts[name] = ocp.args.StandardSave(plain, save_args=args)
    self._policy.rates[step], self._policy.items[step] = success_rate, set(items)
    try:
      self._manager.save(step, args=ocp.args.Composite(**parts), force=True)
    except Exception as error:
      raise self._failed(error) from error

  def finished(self, *, wait: bool = False) -> dict[str, float]:
    """Returns seconds and MiB of a save that ended since the last call, or nothing.

    With ``wait``, waits for a save in progress.

    Raises:
      SaveError: The save failed.
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
    """Waits until everything saved is on disk.

    Raises:
      SaveError: A save failed.
    """
    try:
      self._manager.wait_until_finished()
    except Exception as error:
      raise self._failed(error) from error
    self._saving = None

  def close(self) -> None:
    """Waits as ``wait`` does, then releases Orbax's threads.

    After a failed save it leaves them alone, because they can block each other for
    minutes.
    """
    self.wait()
    self._manager.close()

  def __enter__(self) -> CheckpointWriter:
    return self

  def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
    if kind is None or not issubclass(kind, SaveError):
      self.close()

  def _failed(self, error: Exception) -> SaveError:
    """Removes what a failed save left behind, which may fill the disk."""
    step, _ = self._saving or (None, 0.0)
    self._saving = None
    for part in checkpoint_record.folder(self._run_dir).glob(f"{step}.*-tmp*"):
      shutil.rmtree(part, ignore_errors=True)
    cause = one_line(error)
    if "os_error_code" in str(error):  # Leave out the names of temporary files.
      cause = " ".join(str(error).split()).rpartition(": ")[2]
    return SaveError(f"checkpoint {step} could not be saved: {cause}")


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
