"""The command ``apnpql export``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from apnpql_jax.cli.inputs import checkpoint_step, existing_run
from apnpql_jax.cli.options import Flag, OfCheckpoint
from apnpql_jax.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Export(OfCheckpoint):
  """Exports a policy to use without this package: apnpql export RUN FOLDER [options].

  FOLDER gets the program with its weights, a contract in JSON, and an example.

  apnpql export runs/mine policy

  apnpql export runs/mine policy --checkpoint best --acting mean
  """

  folder: tyro.conf.Positional[str] = ""
  """Folder to make."""

  overwrite: Flag = False
  """Replace an earlier export."""


def export(args: Export) -> dict[str, Any]:
  """Writes the folder of an exported policy and returns what it holds."""
  run_dir = existing_run(args.run, "export", args.task_file)
  if not args.folder:
    raise ConfigError("export needs a folder to make: apnpql export RUN FOLDER")

  from apnpql_jax.deploy.export import export as export_run

  return export_run(
    run_dir,
    Path(args.folder),
    step=checkpoint_step(args.run, args.checkpoint),
    acting=args.acting,
    overwrite=args.overwrite,
  )
