"""Run folders: naming, creating, locking and reading them without accidental loss."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
import contextlib
import fcntl
import os
from pathlib import Path
import shutil
from typing import Any, NamedTuple

from apnpql_jax.atomic import check_utf8, check_writable, existing
from apnpql_jax.config import changes, files
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.runs import provenance, signals
from apnpql_jax.runs.text import read_text, write_text

CONFIG_FILE = "config.json"
"""A folder that holds this file is a run folder."""

_MAX_CONFIG_BYTES = 1 << 20

_PATTERN = "*?[]\\"
"""Characters that Orbax reads as patterns: it would find no file, or the wrong one."""


class RunFolder(NamedTuple):
  """A run folder that exists and holds ``config.json``."""

  path: Path  # absolute
  config: TrainConfig  # as it is now; a resume may have changed it


def create(
  run_dir: Path,
  config: TrainConfig,
  *,
  overwrite: bool = False,
  devices: int = 1,
  origin: Mapping[str, Any] | None = None,
  write_more: Callable[[Path], None] | None = None,
) -> RunFolder:
  """Creates a folder with ``config.json`` and ``versions.json``.

  It is filled under another name, so that a process killed meanwhile leaves the run to
  overwrite intact.

  Args:
    run_dir: The run folder.
    config: Settings of the run.
    overwrite: The run may replace another one.
    devices: Number of devices, recorded with the versions.
    origin: Where the weights that the run starts with come from; None if they are
      drawn.
    write_more: Writes other files of the new run into the folder that it is given.

  Raises:
    FileError: The folder holds a run and ``overwrite`` is not set, it holds anything
      else, or it cannot be created.
  """
  _check_characters(run_dir, _PATTERN)
  _check_replaceable(run_dir, overwrite=overwrite)
  versions = provenance.describe_versions(devices, config.env.task_file)
  versions |= {"origin": origin} if origin else {}
  run_dir = run_dir.absolute()
  new, old = _free_name(run_dir, "new"), _free_name(run_dir, "replaced")
  try:
    new.mkdir(parents=True)
    provenance.write(new, versions)
    if write_more:
      write_more(new)
    write_text(new / CONFIG_FILE, files.config_to_json(config))
    if run_dir.exists():
      run_dir.rename(old)
    new.rename(run_dir)
  except OSError as error:
    if old.exists() and not run_dir.exists():
      old.rename(run_dir)
    shutil.rmtree(new, ignore_errors=True)
    raise FileError(f"cannot make run folder {str(run_dir)!r}: {error}") from None
  with contextlib.suppress(OSError):
    # First: without it, the old folder is no run, however long its removal takes.
    (old / CONFIG_FILE).unlink()
  shutil.rmtree(old, ignore_errors=True)
  return RunFolder(run_dir, config)


def open_run(run_dir: Path) -> RunFolder:
  """Opens an existing run, to resume or evaluate it.

  Raises:
    FileError: It is not a run folder, its configuration cannot be read, or a link
      leads out of it. The run would write, and delete checkpoints, elsewhere.
  """
  _check_characters(run_dir, "\\")  # TensorStore reads a backslash as a slash.
  inside = run_dir.resolve()
  # A run that is training makes and removes folders; ``walk`` passes over those.
  for folder, folders, names in os.walk(run_dir):
    for path in (Path(folder, name) for name in folders + names):
      if path.is_symlink() and not path.resolve().is_relative_to(inside):
        raise FileError(f"{path} is a link that leads out of the run folder")
    if Path(folder) == run_dir and "wandb" in folders:
      folders.remove("wandb")  # There, wandb links to its own logs elsewhere.
  return RunFolder(run_dir.absolute(), load_run_config(run_dir))


def change(run_dir: Path, config: TrainConfig, *, step: int) -> str:
  """Replaces the settings of a run that resumes at ``step``, and records the change.

  Returns:
    The differences as one line, "" if there are none.
  """
  diff = files.config_diff(load_run_config(run_dir), config)
  if diff:
    # First: a process killed in between repeats the record at the next resume.
    provenance.record_change(run_dir, step, diff)
    write_text(run_dir / CONFIG_FILE, files.config_to_json(config))
  return files.format_diff(diff)


@contextlib.contextmanager
def new_run_dir(preset: str, root: Path = Path("runs")) -> Generator[Path, None, None]:
  """Makes and yields the first free folder ``root/<preset>-<n>``, counting from 1.

  No other process can choose it. If it is still empty at the end, it is removed.

  Raises:
    FileError: It cannot be made.
  """
  number = 1
  while not _make(path := root / f"{preset}-{number}"):
    number += 1
  with _removed_if_empty(path):
    yield path


@contextlib.contextmanager
def reserve(run_dir: Path) -> Generator[None, None, None]:
  """Locks the folder of a run that is about to start or resume; makes a missing one.

  If it was missing and is still empty at the end, it is removed.

  Raises:
    FileError: It cannot be made, or another process has reserved it or trains the run.
  """
  made = _make(run_dir)
  with _removed_if_empty(run_dir) if made else contextlib.nullcontext():
    with lock(run_dir):
      yield


def _make(run_dir: Path) -> bool:
  """Makes a folder; returns False if its name is taken."""
  try:
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
      run_dir.mkdir()
      return True
  except OSError as error:
    raise FileError(f"cannot make run folder {str(run_dir)!r}: {error}") from None
  return False


@contextlib.contextmanager
def _removed_if_empty(folder: Path) -> Generator[None, None, None]:
  path = folder.absolute()
  signals.EMPTY_FOLDERS.add(path)
  try:
    yield
  finally:
    signals.EMPTY_FOLDERS.discard(path)
    with contextlib.suppress(OSError):
      path.rmdir()


def load_run_config(
  run_dir: Path, warn: Callable[[str], None] | None = None
) -> TrainConfig:
  """Returns the configuration of a run as it is now.

  Calls ``warn`` with one line that lists the settings that the run predates, if any.

  Raises:
    FileError: This is not a run folder, or its configuration cannot be read.
  """
  path = run_dir / CONFIG_FILE
  if not path.is_file():
    raise FileError(
      f"{str(run_dir)!r} is not a run folder (no {CONFIG_FILE}); "
      f"{_nearby_runs(run_dir)}"
    )

  def report(line: str) -> None:
    if warn:
      warn(f"{path} is {line}")

  try:
    return files.config_from_json(read_text(path, _MAX_CONFIG_BYTES), report)
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  except (OSError, ValueError) as error:
    raise FileError(f"{path} cannot be read: {error}") from None


def split_origin(origin: Path | str) -> tuple[Path, str | None]:
  """Splits ``RUN``, ``RUN:STEP`` or ``RUN:best`` into the run and the rest, if any.

  Raises:
    FileError: There is no such run.
  """
  name, _, step = str(origin).rpartition(":")
  number = step.isascii() and step.isdecimal() and len(step) < 20
  if Path(origin).exists() or not (name and (number or step == "best")):
    name, step = str(origin), ""
  load_run_config(Path(name))
  return Path(name), step or None


def check_start(
  run_dir: Path, config: TrainConfig, *, resume: bool, overwrite: bool, **limits: Any
) -> None:
  """Checks settings and folder of a run before anything is built.

  Args:
    run_dir: The run folder.
    config: Settings of the run.
    resume: The run exists and is resumed.
    overwrite: The run may replace another one.
    **limits: Arguments of ``validate``, which take JAX to find out.

  Raises:
    ConfigError: A setting is invalid, or a resumed run must not change it.
    FileError: The folder cannot be created, resumed or replaced.
  """
  validate(config, **limits)
  if resume:
    check_resumable(run_dir, config)
  else:
    check_free(run_dir, overwrite=overwrite)


def check_resumable(run_dir: Path, wanted: TrainConfig) -> None:
  """Checks that a run can be resumed with these settings.

  Raises:
    ConfigError: A setting that must not change differs, see ``config/changes.py``.
    FileError: Another process trains the run, or checkpoints cannot be saved under its
      path.
  """
  _check_characters(run_dir, _PATTERN)
  check_writable(run_dir)
  changes.check_resumed(load_run_config(run_dir), wanted, str(run_dir))
  _check_idle(run_dir)


@contextlib.contextmanager
def lock(run_dir: Path, *, shared: bool = False) -> Generator[None, None, None]:
  """Holds an exclusive lock on the folder; the OS releases it if the process dies.

  A ``shared`` lock only fails if another process holds the exclusive one.

  Raises:
    FileError: Another process holds the lock, because it trains the run.
  """
  folder = os.open(run_dir, os.O_RDONLY)
  try:
    try:
      kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
      fcntl.flock(folder, kind | fcntl.LOCK_NB)
    except BlockingIOError:
      raise FileError(f"{str(run_dir)!r} is being trained by another process") from None
    except OSError:  # Some file systems have no locks.
      pass
    yield
  finally:
    os.close(folder)


def _check_idle(run_dir: Path) -> None:
  with lock(run_dir, shared=True):
    pass


def check_free(run_dir: Path, *, overwrite: bool) -> None:
  """Checks that a run folder can be created: it is new, empty, or to be overwritten.

  Raises:
    FileError: The folder holds a run and ``overwrite`` is not set, another process has
      reserved it or trains its run, it holds anything else, which is never removed, or
      it cannot be written.
  """
  _check_characters(run_dir, _PATTERN)
  check_writable(run_dir.parent)
  _check_replaceable(run_dir, overwrite=overwrite)
  if run_dir.exists():
    _check_idle(run_dir)


def _check_replaceable(run_dir: Path, *, overwrite: bool) -> None:
  """Raises ``FileError`` if there is anything that ``create`` must not replace."""
  if not run_dir.exists():
    return
  if not run_dir.is_dir() or run_dir.is_symlink():
    raise FileError(f"{str(run_dir)!r} is not a folder; choose another --run")
  if not any(run_dir.iterdir()):
    return
  if not (run_dir / CONFIG_FILE).is_file():
    raise FileError(
      f"{str(run_dir)!r} contains files that are not a run; choose another --run"
    )
  if not overwrite:
    raise FileError(
      f"{str(run_dir)!r} holds a run; resume it with --resume {run_dir}, replace it "
      "with --overwrite, or choose another --run"
    )


def check_disk(run_dir: Path, next_bytes: int, all_bytes: int) -> str:
  """Checks that the disk has room for a checkpoint of at most this size.

  Checkpoints are compressed, so that fewer bytes may do.

  Args:
    run_dir: The run folder, which may not exist yet.
    next_bytes: Size of the next checkpoint before compression.
    all_bytes: The same for all that exist at the same time.

  Returns:
    A warning if there may be no room for all, else "".

  Raises:
    FileError: There is no room for one.
  """
  one, every = next_bytes / 2**30, all_bytes / 2**30
  free = shutil.disk_usage(existing(run_dir)).free / 2**30
  if one > free:
    raise FileError(
      f"a checkpoint needs up to {one:.2f} GiB, but the disk of {str(run_dir)!r} has "
      f"{free:.2f} GiB; free some, or lower replay.capacity"
    )
  if every > free:
    return (
      f"the disk has {free:.2f} GiB, but the checkpoints that are kept need up to "
      f"{every:.2f} GiB together; lower keep_checkpoints or replay.capacity"
    )
  return ""


def _check_characters(run_dir: Path, refused: str) -> None:
  """Raises ``FileError`` if the absolute path is not UTF-8 or has such characters."""
  check_utf8(run_dir)
  path = str(run_dir.absolute())
  if found := sorted(set(path) & set(refused)):
    raise FileError(
      f"checkpoints cannot be kept under {path!r} because of {' '.join(found)} in the "
      "path; rename that folder or choose another one"
    )


def _free_name(path: Path, kind: str) -> Path:
  number = 1
  while (free := path.with_name(f"{path.name}.{kind}-{number}")).exists():
    number += 1
  return free


def _nearby_runs(run_dir: Path) -> str:
  roots = dict.fromkeys((run_dir.parent, Path("runs")))
  found = [path.parent for r in roots for path in sorted(r.glob(f"*/{CONFIG_FILE}"))]
  if not found:
    return "there is none next to it or in runs/; `apnpql train` makes one"
  return "choose from " + ", ".join(str(path) for path in found[:8])
