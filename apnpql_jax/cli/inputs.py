"""Inputs of commands: runs, their checkpoints, and tasks."""

from __future__ import annotations

from pathlib import Path

from apnpql_jax.config import files, user_files
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs import provenance, run_folder


def existing_run(run: str, command: str, task_file: Path | None) -> Path:
  """Returns the folder of a run; raises ``UserError`` if it is not one."""
  if not run:
    raise ConfigError(f"{command} needs a run folder: apnpql {command} RUN")
  run_config(Path(run), task_file)
  return Path(run)


def run_config(run_dir: Path, task_file: Path | None) -> TrainConfig:
  """Returns the settings of a run, after executing the file of its task, if given."""
  config = run_folder.load_run_config(run_dir, print_line)
  if task_file is not None:
    user_files.load(task_file)
    if provenance.changed_task(run_dir, task_file):
      print_line(f"{task_file} or its MJCF has changed since {run_dir} began")
  elif config.env.task_file:
    user_files.check_loaded(config.env.task_file, config.env.task)
  return config


def checkpoint_step(run: Path | str, checkpoint: str) -> int | None:
  """Returns the step of the checkpoint asked for; None for the newest."""
  if checkpoint == "newest":
    return None
  if checkpoint == "best":
    from apnpql_jax.runs.checkpoint_reader import best_step

    return best_step(Path(run))
  if checkpoint.isdecimal() and len(checkpoint) < 20:
    return int(checkpoint)
  raise ConfigError(
    f"unknown --checkpoint {checkpoint!r}; choose from newest, best, or a step"
  )


def task_env(task: str) -> EnvConfig:
  """Returns the environment of a task that exists, or of the preset in its file."""
  if not user_files.is_file(task):
    from apnpql_jax import tasks

    check_name("task", task, tasks.task_names())
  return files.task_env(task)
