"""Checkpoints of the whole training state, written in the background with Orbax.

Each checkpoint carries the configuration it belongs to, the format version and the
shape and dtype of every leaf, so that a wrong one is refused by name before anything
is read into it: Orbax by itself would cast a leaf of another dtype without a word.
Typed PRNG keys come back as typed keys.
"""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

import jax

from apnpql_jax import leaves
from apnpql_jax.config import (
  ConfigError,
  TrainConfig,
  config_diff,
  config_from_json,
  config_to_json,
  format_diff,
)
from apnpql_jax.runs import MAY_CHANGE

SCHEMA_VERSION = 1
"""Raised whenever what the code expects in a checkpoint changes."""

_FOLDER = "checkpoints"
_CHUNK_BYTES = 16 << 20
"""Unit of compression: a replay as one chunk took one core twice as long."""


class CheckpointWriter:
  """Saves the checkpoints of one run and deletes those no longer wanted.

  Use as a context manager: leaving it waits until the last save is on disk. A
  checkpoint becomes visible only once it is complete.
  """

  def __init__(
    self,
    run_dir: Path,
    config: TrainConfig,
    *,
    keep: int,
    keep_best: bool = True,
    resume_step: int | None = None,
  ):
    """Opens the run for writing.

    Args:
      run_dir: the run folder.
      config: stored beside every state.
      keep: newest checkpoints kept.
      keep_best: keep the one of highest success rate too (the newest of equals).
      resume_step: the step the run goes on from; checkpoints of later steps belong
        to a future that will now be another one, and are deleted.
    """
    import orbax.checkpoint as ocp

    self._config = config
    self._policy = _KeepNewestAndBest(keep, _rates(run_dir) if keep_best else None)
    options = ocp.CheckpointManagerOptions(
      preservation_policy=self._policy, cleanup_tmp_directories=True
    )
    self._manager = ocp.CheckpointManager(_folder(run_dir), options=options)
    for step in self._manager.all_steps():
      if resume_step is not None and step > resume_step:
        self._manager.delete(step)

  def save(self, step: int, state: Any, *, success_rate: float | None = None) -> bool:
    """Starts writing ``state``; it may be donated as soon as this returns.

    On a CPU, donated buffers that are still being read are replaced by new ones, so
    that memory for a second state is needed. Waits for an earlier save first.

    Args:
      step: environment steps done.
      state: pytree of arrays, typed PRNG keys included.
      success_rate: what decides which checkpoint is best; None if not evaluated.

    Returns:
      False if this step had been saved before; nothing is written then.
    """
    import orbax.checkpoint as ocp

    if step in self._manager.all_steps():
      return False
    success_rate = None if success_rate is None else float(success_rate)
    meta = {
      "schema_version": SCHEMA_VERSION,
      "config": json.loads(config_to_json(self._config)),
      "success_rate": success_rate,
      "leaves": leaves.describe(state),
      "key_impls": leaves.key_impls(state),
    }
    plain = leaves.to_plain(state)
    chunked = jax.tree.map(lambda _: ocp.SaveArgs(chunk_byte_size=_CHUNK_BYTES), plain)
    items = ocp.args.Composite(
      state=ocp.args.StandardSave(plain, save_args=chunked),
      meta=ocp.args.JsonSave(meta),
    )
    self._policy.rate(step, success_rate)
    return self._manager.save(step, args=items, force=True)

  def close(self) -> None:
    """Returns when everything saved is on disk; raises what a save failed of."""
    try:
      self._manager.wait_until_finished()
    finally:
      self._manager.close()

  def __enter__(self) -> CheckpointWriter:
    return self

  def __exit__(self, *exception: object) -> None:
    self.close()


def all_steps(run_dir: Path) -> list[int]:
  """Steps of the complete checkpoints of a run, ascending."""
  from orbax.checkpoint import utils

  return sorted(utils.checkpoint_steps(_folder(run_dir)))


def latest_step(run_dir: Path) -> int | None:
  """Step of the newest complete checkpoint; None if there is none."""
  return max(all_steps(run_dir), default=None)


def best_step(run_dir: Path) -> int | None:
  """Step of highest success rate, the newest of equals; None if none was evaluated."""
  return _best(_rates(run_dir))


def check(run_dir: Path, step: int | None, *, config: TrainConfig | None = None) -> int:
  """Refuses a checkpoint that cannot be restored, before anything else is built.

  Args:
    run_dir: the run folder.
    step: the newest if None.
    config: as of ``restore``.

  Returns:
    the step.

  Raises:
    ConfigError: there is no such checkpoint, or it belongs to another configuration
      or format.
  """
  step = _existing_step(run_dir, step)
  meta = _read_meta(run_dir, step)
  if config is not None:
    diff = config_diff(config_from_json(json.dumps(meta["config"])), config)
    diff = {field: pair for field, pair in diff.items() if field not in MAY_CHANGE}
    if diff:
      raise ConfigError(
        f"checkpoint {step} of {str(run_dir)!r} belongs to other settings: "
        f"{format_diff(diff)}"
      )
  return step


def restore(
  run_dir: Path,
  step: int | None,
  example_state: Any,
  *,
  config: TrainConfig | None = None,
) -> Any:
  """Reads a checkpoint back, bit by bit as it was saved.

  Args:
    run_dir: the run folder.
    step: the newest if None.
    example_state: the same pytree, with arrays or ShapeDtypeStructs. The latter, as
      from ``jax.eval_shape``, spare the memory of a second state.
    config: if given, what the checkpoint must have been made with, apart from the
      settings that a resumed run may change.

  Raises:
    ConfigError: there is no such checkpoint, it belongs to another configuration or
      format, it holds other leaves than the example, or its files cannot be read.
  """
  step = check(run_dir, step, config=config)
  name = f"checkpoint {step} of {str(run_dir)!r}"
  meta = _read_meta(run_dir, step)
  _check_leaves(name, meta["leaves"], leaves.describe(example_state))
  state = _read(name, _folder(run_dir), step, leaves.abstract(example_state))
  return leaves.to_typed(state, meta["key_impls"], example_state)


class _KeepNewestAndBest:
  """Orbax policy of what to keep; its own forget the metrics of earlier processes."""

  def __init__(self, keep: int, rates: dict[int, float] | None):
    self._keep, self._rates = keep, rates

  def rate(self, step: int, success_rate: float | None) -> None:
    if self._rates is not None:
      self._rates.pop(step, None)  # Of a future that was not resumed.
      if success_rate is not None:
        self._rates[step] = success_rate

  def should_preserve(self, checkpoints: Sequence[Any], **_: Any) -> list[bool]:
    steps = sorted(info.step for info in checkpoints)
    rates = {k: v for k, v in (self._rates or {}).items() if k in steps}
    kept = {*steps[-self._keep :], _best(rates)}
    return [info.step in kept for info in checkpoints]


def _best(rates: dict[int, float]) -> int | None:
  return max(rates, key=lambda step: (rates[step], step), default=None)


def _rates(run_dir: Path) -> dict[int, float]:
  """Step -> success rate of the checkpoints that were evaluated."""
  metas = {step: _read_meta(run_dir, step) for step in all_steps(run_dir)}
  rates = {step: meta["success_rate"] for step, meta in metas.items()}
  return {step: rate for step, rate in rates.items() if rate is not None}


def _existing_step(run_dir: Path, step: int | None) -> int:
  steps = all_steps(run_dir)
  if not steps:
    raise ConfigError(f"{str(run_dir)!r} has no checkpoint")
  step = steps[-1] if step is None else step
  if step not in steps:
    valid = ", ".join(map(str, steps))
    raise ConfigError(f"{str(run_dir)!r} has no checkpoint {step}; choose from {valid}")
  return step


def _read_meta(run_dir: Path, step: int) -> dict[str, Any]:
  path = _folder(run_dir) / str(step) / "meta" / "metadata"
  name = f"checkpoint {step} of {str(run_dir)!r}"
  try:
    meta = json.loads(path.read_text(encoding="utf-8"))
    version = meta["schema_version"]
  except (OSError, ValueError, KeyError, TypeError) as error:
    raise ConfigError(f"{name} cannot be read: {_first_line(error)}") from None
  if version != SCHEMA_VERSION:
    raise ConfigError(f"{name} has format {version}; this code reads {SCHEMA_VERSION}")
  return meta


def _read(name: str, folder: Path, step: int, example: Any) -> Any:
  import orbax.checkpoint as ocp

  try:
    with ocp.StandardCheckpointer() as reader:
      return reader.restore(folder / str(step) / "state", example)
  except Exception as error:  # Whatever Orbax or the file system found wrong.
    raise ConfigError(f"{name} cannot be read: {_first_line(error)}") from error


def _check_leaves(name: str, saved: dict[str, str], wanted: dict[str, str]) -> None:
  for path in sorted(saved.keys() | wanted.keys()):
    held, expected = saved.get(path, "nothing"), wanted.get(path, "nothing")
    if held != expected:
      raise ConfigError(f"{name} holds {held} at {path}, where {expected} is expected")


def _folder(run_dir: Path) -> Path:
  return run_dir.absolute() / _FOLDER


def _first_line(error: BaseException) -> str:
  return " ".join(str(error).split())[:200] or type(error).__name__
