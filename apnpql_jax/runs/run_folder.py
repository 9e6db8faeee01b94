"""Run folders: naming, creating, locking and reading them without accidental loss."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
import fcntl
import json
import os
from pathlib import Path
import shutil

from apnpql_jax.config import codec
from apnpql_jax.config.files import (
  config_diff,
  config_from_json,
  config_to_json,
  format_diff,
)
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError, FileError, UserError
from apnpql_jax.runs.text import read_text, write_text
from apnpql_jax.runs.versions import describe_versions

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


@dataclasses.dataclass(frozen=True)
class RunFolder:
  """Paths of one run; the folder exists and holds ``config.json``."""

  path: Path
  """The folder itself."""

  config: TrainConfig
  """The configuration the run was started with."""

  @property
  def versions(self) -> Path:
    """What the run was made with, see ``describe_versions``."""
    return self.path / "versions.json"

  @property
  def metrics_jsonl(self) -> Path:
    """Metrics, one JSON object per line."""
    return self.path / "metrics.jsonl"

  @property
  def curve(self) -> Path:
    """Success rate over steps and time."""
    return self.path / "curve.png"

  @property
  def videos(self) -> Path:
    """Folder of evaluation videos; made by whoever writes the first one."""
    return self.path / "videos"

  @property
  def faults(self) -> Path:
    """Folder of updates that were not finite, see ``faults``."""
    return self.path / "faults"


def create(
  run_dir: Path, config: TrainConfig, *, overwrite: bool = False, devices: int = 1
) -> RunFolder:
  """Makes the folder and writes ``config.json`` and ``versions.json`` into it.

  Raises:
    FileError: it holds a run and ``overwrite`` is not set, or something that is no
      run, which is never removed; or it cannot be made.
  """
  check_free(run_dir, overwrite=overwrite)
  versions = json.dumps(describe_versions(devices), indent=2) + "\n"
  with fresh_run_dir(run_dir) as path:
    folder = RunFolder(path=path, config=config)
    write_text(folder.versions, versions)
    # Last, because its presence says that this is a run.
    write_text(path / CONFIG_FILE, config_to_json(config))
  return folder


def open_run(run_dir: Path) -> RunFolder:
  """An existing run, to resume or to evaluate.

  Raises:
    FileError: it is not a run folder, its configuration cannot be read, or links
      lead out of it.
  """
  check_contained(run_dir)
  return RunFolder(path=run_dir.absolute(), config=load_run_config(run_dir))


def new_run_dir(preset: str, root: Path = Path("runs")) -> Path:
  """First free ``root/<preset>-<n>``, n from 1; the folder is not made."""
  number = 1
  while (root / f"{preset}-{number}").exists():
    number += 1
  return root / f"{preset}-{number}"


def load_run_config(
  run_dir: Path, say: Callable[[str], None] = codec.ignore
) -> TrainConfig:
  """The configuration that a run was started with.

  Args:
    run_dir: the run folder.
    say: is told in one line which settings came after the run, if any.

  Raises:
    FileError: not a run folder, or its configuration cannot be read.
  """
  path = run_dir / CONFIG_FILE
  if not path.is_file():
    raise FileError(
      f"{str(run_dir)!r} is not a run folder (no {CONFIG_FILE}); "
      f"{_nearby_runs(run_dir)}"
    )
  try:
    text = read_text(path, _MAX_CONFIG_BYTES)
    return config_from_json(text, lambda line: say(f"{path} is {line}"))
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  except (OSError, ValueError) as error:
    raise FileError(f"{path} cannot be read: {error}") from None


def check_contained(run_dir: Path) -> None:
  """Refuses a run folder from which links lead outside.

  What a run writes, and the checkpoints it deletes, would then lie elsewhere.

  Raises:
    FileError: names the first such link.
  """
  inside = run_dir.resolve()
  for path in sorted(run_dir.rglob("*")):
    if path.is_symlink() and not path.resolve().is_relative_to(inside):
      raise FileError(f"{path} is a link that leads out of the run folder")


def check_resumable(run_dir: Path, wanted: TrainConfig) -> None:
  """Refuses to go on with settings other than those of the checkpoint.

  Raises:
    ConfigError: a setting outside ``MAY_CHANGE`` differs; the message lists each.
    FileError: another process trains the run.
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
def lock(run_dir: Path, *, shared: bool = False) -> Generator[None, None, None]:
  """Holds an exclusive lock on the folder; the OS releases it if the process dies.

  Args:
    run_dir: the run folder.
    shared: take a shared lock, which fails if another process holds the exclusive one.

  Raises:
    FileError: another process trains there.
  """
  folder = os.open(run_dir, os.O_RDONLY)
  try:
    try:
      kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
      fcntl.flock(folder, kind | fcntl.LOCK_NB)
    except BlockingIOError:
      raise FileError(f"{str(run_dir)!r} is trained by another process") from None
    except OSError:  # Some file systems have no locks.
      pass
    yield
  finally:
    os.close(folder)


def _check_idle(run_dir: Path) -> None:
  with lock(run_dir, shared=True):
    pass


def check_free(run_dir: Path, *, overwrite: bool) -> None:
  """Refuses a run folder that holds something, unless it is a run to overwrite.

  Raises:
    FileError: the folder is in use, or is no run folder and so never removed, or
      its run is being trained.
  """
  if not run_dir.exists():
    return
  if not run_dir.is_dir() or run_dir.is_symlink():
    raise FileError(f"{str(run_dir)!r} is not a folder; choose another --run")
  if not any(run_dir.iterdir()):
    return
  if not (run_dir / CONFIG_FILE).is_file():
    raise FileError(
      f"{str(run_dir)!r} holds something that is not a run; choose another --run"
    )
  if not overwrite:
    raise FileError(
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
    FileError: the folder cannot be made; also re-raised from the body.
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
    raise FileError(f"cannot make run folder {str(run_dir)!r}: {error}") from None
  try:
    yield run_dir
  except BaseException as error:
    # Refused, or stopped before anything was written: give back what was there.
    if isinstance(error, UserError) or not (run_dir / CONFIG_FILE).exists():
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
