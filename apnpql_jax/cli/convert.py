"""The command ``apnpql convert``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from apnpql_jax.cli.inputs import task_env
from apnpql_jax.cli.options import Command, Flag
from apnpql_jax.cli.outputs import (
  check_demonstrations,
  earlier_demonstrations,
  save_demonstrations,
)
from apnpql_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Convert(Command):
  """Converts a recording to demonstrations: apnpql convert REC TASK OUT.npz.

  apnpql convert recording.npz push_plate mine.npz

  apnpql convert other.npz push_plate mine.npz --append --solved-only
  """

  recording: tyro.conf.Positional[str] = ""
  """Joint trajectories and object poses (docs/demonstrations.md), another
  demonstrations file, or the folder of a dataset of LeRobot, such as the log of a
  simulated robot."""

  task: tyro.conf.Positional[str] = ""
  """Task of the recording, or the path of its file; `apnpql list` shows all."""

  out: tyro.conf.Positional[str] = ""
  """File to write, for --replay.demonstrations."""

  append: Flag = False
  """Add the episodes to the file if it exists."""

  solved_only: Flag = False
  """Keep only solved episodes."""

  allow_unsolved: Flag = False
  """Write the file even if no episode in it is solved."""

  overwrite: Flag = False
  """Replace the file if it exists."""


def convert(args: Convert) -> dict[str, Any]:
  """Converts recorded joint trajectories into demonstrations."""
  if not args.out:
    raise ConfigError("usage: apnpql convert REC TASK OUT.npz")
  recording, out = Path(args.recording), Path(args.out)
  check_demonstrations(out, overwrite=args.overwrite, append=args.append)
  if args.append and recording.resolve() == out.resolve():
    raise ConfigError(f"{out} cannot be added to itself")
  env = task_env(args.task)

  from apnpql_jax import devices, tasks
  from apnpql_jax.data import demonstrations, lerobot, recordings
  from apnpql_jax.data.lerobot import conversion

  devices.start()
  earlier = earlier_demonstrations(out, env) if args.append else None
  task = tasks.make_task(env.task)
  if lerobot.is_dataset(recording):
    demos = conversion.convert(recording, task.scene, period_s=env.control_period_s)
  elif demonstrations.is_demonstrations(recording):
    demos = demonstrations.load(recording, task, env, allow_unsolved=True)
  else:
    demos = recordings.convert(recording, task.scene, period_s=env.control_period_s)
  if not args.allow_unsolved:
    demonstrations.check_solved(demos, task, env, flag="--allow-unsolved")
  demonstrations.check_reachable(demos, task)
  return save_demonstrations(out, env, demos, earlier, solved_only=args.solved_only)
