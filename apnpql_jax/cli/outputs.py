"""Outputs of commands: paths that can be written, and demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from apnpql_jax.atomic import check_utf8, check_writable
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.errors import ConfigError

if TYPE_CHECKING:
  from apnpql_jax.data.demonstrations import Demonstrations


def check_free(path: Path | None, *, overwrite: bool) -> None:
  """Raises ``ConfigError`` if a file exists and must not be replaced."""
  if path is not None and path.is_file() and not overwrite:
    raise ConfigError(f"{path} exists; replace it with --overwrite, or name another")


def check_output(path: Path) -> None:
  """Raises ``UserError`` if a file cannot be written there."""
  check_utf8(path)
  check_writable(path.absolute().parent)
  _check_place(path)


def check_demonstrations(path: Path, *, overwrite: bool, append: bool) -> None:
  """Raises ``ConfigError`` if demonstrations cannot be written, or must not be."""
  if overwrite and append:
    raise ConfigError("use either --append or --overwrite")
  _check_place(path)
  check_writable(path.absolute().parent)
  check_free(path, overwrite=overwrite or append)


def _check_place(path: Path) -> None:
  if path.is_dir() or not path.absolute().parent.is_dir():
    raise ConfigError(f"{path} is a folder or its parent is missing; name another file")


def earlier_demonstrations(path: Path, env: EnvConfig) -> Demonstrations | None:
  """Returns the demonstrations in a file, or None if there is no file."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations

  if not path.exists():
    return None
  return demonstrations.load(path, tasks.make_task(env.task), env, allow_unsolved=True)


def save_demonstrations(
  path: Path,
  env: EnvConfig,
  demos: Demonstrations,
  earlier: Demonstrations | None,
  *,
  solved_only: bool,
) -> dict[str, Any]:
  """Writes demonstrations after ``earlier`` ones; returns the file and its counts."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations

  task = tasks.make_task(env.task)
  demonstrations.check(demos, task.scene)
  if solved_only:
    demos = demonstrations.only_solved(demos, task, env)
  if earlier is not None:
    demos = demonstrations.join(earlier, demos)
  period_s = env.control_period_s
  counts = demonstrations.save(path, demos, task=env.task, control_period_s=period_s)
  solved = int(demonstrations.solved(demos, task, env).sum())
  return counts | {"solved_demonstrations": solved}
