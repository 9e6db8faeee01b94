"""Run folders: naming a new one, reading an old one, never overwriting by accident."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import fcntl
import os
from pathlib import Path
import shutil

from apnpql_jax.config import codec
from apnpql_jax.config.files import config_diff, config_from_json, format_diff
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError

CONFIG_FILE = "config.json"
"""Its presence makes a folder a run folder."""

_MAX_CONFIG_BYTES = 1 << 20

MAY_CHANGE = (
  "total_steps",
  "eval_every",
  "eval_episodes",
  "checkpoint_every",
  "keep_checkpoints",
  "save_replay_every",
  "max_skipped_updates",
  "video",
  "sinks",
)
"""Settings that a resumed run may change: none of them alters what is learned from a
given state of the run."""


def new_run_dir(preset: str, root: Path = Path("runs")) -> Path:
  """First free ``root/<preset>-<n>``, n from 1; the folder is not made."""
  number = 1
  while (root / f"{preset}-{number}").exists():
    number += 1
  return root / f"{preset}-{number}"


def load_run_config(
  run_dir: Path, say: Callable[[str], None] = codec.unsaid
) -> TrainConfig:
  """The configuration that a run was started with.

  Args:
    run_dir: the run folder.
    say: is told in one line which settings came after the run, if any.

  Raises:
    ConfigError: not a run folder, or its configuration cannot be read.
  """
  path = run_dir / CONFIG_FILE
  if not path.is_file():
    raise ConfigError(
      f"{str(run_dir)!r} is not a run folder (no {CONFIG_FILE}); "
      f"{_nearby_runs(run_dir)}"
    )
  try:
    text = read_small(path, _MAX_CONFIG_BYTES)
    return config_from_json(text, lambda line: say(f"{path} is {line}"))
  except ConfigError as error:
    raise ConfigError(f"{path}: {error}") from None
  except (OSError, ValueError) as error:
    raise ConfigError(f"{path} cannot be read: {error}") from None


def read_small(path: Path, limit: int) -> str:
  """The text of a file that other people may have made.

  Raises:
    ValueError: it has more than ``limit`` bytes, or is not UTF-8.
  """
  with path.open("rb") as file:
    data = file.read(limit + 1)
  if len(data) > limit:
    raise ValueError(f"more than {limit} bytes")
  return data.decode("utf-8")


def check_contained(run_dir: Path) -> None:
  """Refuses a run folder from which links lead outside.

  What a run writes, and the checkpoints it deletes, would then lie elsewhere.

  Raises:
    ConfigError: names the first such link.
  """
  inside = run_dir.resolve()
  for path in sorted(run_dir.rglob("*")):
    if path.is_symlink() and not path.resolve().is_relative_to(inside):
      raise ConfigError(f"{path} is a link that leads out of the run folder")


def check_resumable(run_dir: Path, wanted: TrainConfig) -> None:
  """Refuses to go on with settings other than those of the checkpoint.

  Raises:
    ConfigError: a setting outside ``MAY_CHANGE`` differs; the message lists each. Or
      the run is being trained.
  """
  diff = config_diff(load_run_config(run_dir), wanted)
  diff = {name: pair for name, pair in diff.items() if name not in MAY_CHANGE}
  if diff:
    raise ConfigError(
      f"{str(run_dir)!r} was made with other settings: {format_diff(diff)}; resume "
      f"it without them (only {', '.join(MAY_CHANGE)} may change), or start a new run"
    )
  _check_idle(run_dir)


@contextlib.contextmanager
def alone(run_dir: Path, *, lock: int = fcntl.LOCK_EX) -> Generator[None, None, None]:
  """Keeps other processes from training in the folder; a killed one lets go of it.

  Args:
    run_dir: the run folder.
    lock: a shared one only looks whether there is somebody.

  Raises:
    ConfigError: another process trains there.
  """
  folder = os.open(run_dir, os.O_RDONLY)
  try:
    try:
      fcntl.flock(folder, lock | fcntl.LOCK_NB)
    except BlockingIOError:
      raise ConfigError(f"{str(run_dir)!r} is trained by another process") from None
    except OSError:  # Not every file system has locks.
      pass
    yield
  finally:
    os.close(folder)


def _check_idle(run_dir: Path) -> None:
  with alone(run_dir, lock=fcntl.LOCK_SH):
    pass


def check_free(run_dir: Path, *, overwrite: bool) -> None:
  """Refuses a run folder that holds something, unless it is a run to overwrite.

  Raises:
    ConfigError: the folder is in use, or is no run folder and so never removed, or
      its run is being trained.
  """
  if not run_dir.exists():
    return
  if not run_dir.is_dir() or run_dir.is_symlink():
    raise ConfigError(f"{str(run_dir)!r} is not a folder; choose another --run")
  if not any(run_dir.iterdir()):
    return
  if not (run_dir / CONFIG_FILE).is_file():
    raise ConfigError(
      f"{str(run_dir)!r} holds something that is not a run; choose another --run"
    )
  if not overwrite:
    raise ConfigError(
      f"{str(run_dir)!r} holds a run; go on with --resume {run_dir}, replace it with "
      "--overwrite, or choose another --run"
    )
  _check_idle(run_dir)


@contextlib.contextmanager
def fresh_run_dir(run_dir: Path) -> Generator[Path, None, None]:
  """An empty folder at ``run_dir``; what lay there is put aside, then removed.

  If the body refuses the configuration, or is stopped before it has written
  ``config.json``, the folder is as it was before.

  Raises:
    ConfigError: the folder cannot be made; also re-raised from the body.
  """
  run_dir = run_dir.absolute()
  aside = _free_name(run_dir) if run_dir.exists() else None
  try:
    if aside is not None:
      run_dir.rename(aside)
    run_dir.mkdir(parents=True)
  except OSError as error:
    if aside is not None and aside.exists() and not run_dir.exists():
      aside.rename(run_dir)
    raise ConfigError(f"cannot make run folder {str(run_dir)!r}: {error}") from None
  try:
    yield run_dir
  except BaseException as error:
    # Refused, or stopped before anything was written: give back what was there.
    if isinstance(error, ConfigError) or not (run_dir / CONFIG_FILE).exists():
      shutil.rmtree(run_dir, ignore_errors=True)
      if aside is not None:
        aside.rename(run_dir)
      raise
    _remove(aside)
    raise
  _remove(aside)


def _remove(folder: Path | None) -> None:
  if folder is not None:
    shutil.rmtree(folder, ignore_errors=True)


def _free_name(run_dir: Path) -> Path:
  number = 1
  while (path := run_dir.with_name(f"{run_dir.name}.replaced-{number}")).exists():
    number += 1
  return path


def _nearby_runs(run_dir: Path) -> str:
  roots = dict.fromkeys((run_dir.parent, Path("runs")))
  found = [path.parent for r in roots for path in sorted(r.glob(f"*/{CONFIG_FILE}"))]
  if not found:
    return "there is none beside it or in runs/; `apnpql train` makes one"
  return "choose from " + ", ".join(str(path) for path in found[:8])
