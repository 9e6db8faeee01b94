"""The command ``apnpql collect``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from apnpql_jax.atomic import check_writable
from apnpql_jax.cli.inputs import task_env
from apnpql_jax.cli.options import File, Flag, Play
from apnpql_jax.cli.outputs import (
  check_demonstrations,
  check_free,
  earlier_demonstrations,
  save_demonstrations,
)
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.errors import ConfigError, check_name

if TYPE_CHECKING:
  from apnpql_jax.data.demonstrations import Demonstrations

FORMATS = ("npz", "lerobot")
"""Formats of what ``collect`` saves."""


@dataclasses.dataclass(frozen=True)
class Collect(Play):
  """Plays episodes with the scripted expert: apnpql collect TASK [options].

  apnpql collect push_plate --video expert.mp4

  apnpql collect push_plate --episodes 200 --noise 0.03 --save mine.npz

  apnpql collect push_plate --save mine --format lerobot
  """

  task: tyro.conf.Positional[str] = ""
  """Task to play, or the path of its file; `apnpql list` shows all."""

  backend: str = "auto"
  """Physics engine: auto, mjx or native."""

  noise: float = 0.0
  """Standard deviation of the noise on the expert's joint velocities (rad/s)."""

  save: File = None
  """Also record the same number of episodes, started from training resets, to this
  demonstrations file or dataset folder."""

  format: str = "npz"
  """Format of --save: npz (demonstrations for training) or lerobot (a dataset with
  videos, for LeRobot)."""

  append: Flag = False
  """Add the episodes to --save if it exists."""

  solved_only: Flag = False
  """Save only solved episodes."""


def collect(args: Collect) -> dict[str, Any]:
  """Plays episodes with the scripted expert of a task."""
  check_free(args.video, overwrite=args.overwrite)
  check_name("--format", args.format, FORMATS)
  dataset = args.format == "lerobot"
  if args.save is None and (args.append or args.solved_only or dataset):
    raise ConfigError("--append, --solved-only and --format need --save")
  if args.save is not None and dataset:
    _check_dataset(args.save, append=args.append)
  elif args.save is not None:
    check_demonstrations(args.save, overwrite=args.overwrite, append=args.append)
  # The expert acts on privileged poses, so images are not needed.
  env = dataclasses.replace(task_env(args.task), backend=args.backend, obs="state")

  from apnpql_jax.envs.env import make_env
  from apnpql_jax.training import expert
  from apnpql_jax.training.evaluate import evaluate_expert

  earlier = None
  if args.save is not None and args.append:
    earlier = earlier_demonstrations(args.save, env)
  settings: dict[str, Any] = {
    "episodes": args.episodes,
    "seed": args.seed,
    "noise": args.noise,
  }
  figures = evaluate_expert(env, video=args.video, **settings)
  if args.save is not None:
    demos = expert.record_expert(make_env(env), **settings)
    if dataset:
      figures |= _save_dataset(args, args.save, env, demos)
    else:
      figures |= save_demonstrations(
        args.save, env, demos, earlier, solved_only=args.solved_only
      )
  return figures


def _check_dataset(path: Path, *, append: bool) -> None:
  """Raises ``UserError`` if a dataset cannot be written."""
  if append:
    raise ConfigError("--append needs --format npz; name a new folder for a dataset")
  if path.is_file() or path.is_dir() and any(path.iterdir()):
    raise ConfigError(f"{path} exists; name a new folder for the dataset")
  check_writable(path)

  from apnpql_jax.data import lerobot

  lerobot.check_available()


def _save_dataset(
  args: Collect, path: Path, env: EnvConfig, demos: Demonstrations
) -> dict[str, Any]:
  """Writes demonstrations as a dataset; returns the folder and its counts."""
  from apnpql_jax import tasks
  from apnpql_jax.data import demonstrations
  from apnpql_jax.training.expert_dataset import write_dataset

  task = tasks.make_task(env.task)
  if args.solved_only:
    demos = demonstrations.only_solved(demos, task, env)
  return write_dataset(path, demos, task, env)
