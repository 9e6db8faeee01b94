"""The command ``apnpql repeat``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from apnpql_jax.cli.inputs import run_config
from apnpql_jax.cli.options import OfRun
from apnpql_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Repeat(OfRun):
  """Repeats an update with NaN or infinity: apnpql repeat RUN/faults/step_<n>.npz.

  apnpql repeat runs/mine/faults/step_00001024.npz

  apnpql repeat runs/mine/faults/step_00001024.npz --task-file my_task.py
  """

  file: tyro.conf.Positional[str] = ""
  """File that a run wrote when it stopped, still in its run folder."""


def repeat(args: Repeat) -> dict[str, Any]:
  """Repeats the update that stopped a run and names what was not finite."""
  if not args.file:
    raise ConfigError("repeat needs a file: apnpql repeat RUN/faults/step_<n>.npz")
  path = Path(args.file).absolute()
  run_config(path.parent.parent, args.task_file)

  from apnpql_jax import devices
  from apnpql_jax.training import skipped_updates

  devices.start()
  return skipped_updates.repeat(path)
