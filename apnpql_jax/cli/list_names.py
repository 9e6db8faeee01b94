"""The command ``apnpql list``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from apnpql_jax.cli.options import Command, Flag
from apnpql_jax.config import files, user_files
from apnpql_jax.config.checks import BACKENDS


@dataclasses.dataclass(frozen=True)
class List(Command):
  """Lists the tasks, presets, algorithms and backends: apnpql list [FILE...].

  apnpql list --json

  apnpql list my_task.py --contacts
  """

  files: tyro.conf.Positional[tuple[Path, ...]] = ()
  """Python files whose tasks to build and list as well."""

  contacts: Flag = False
  """Report contacts and physics speed of every scene instead; compiles for minutes."""


def list_names(args: List) -> dict[str, Any]:
  """Returns the names that other commands accept, or a contact report of each task.

  Builds the tasks of ``args.files``, so that what is wrong with them shows.
  """
  modules = [user_files.load(file) for file in args.files]
  from apnpql_jax import devices, tasks
  from apnpql_jax.agents import table_one

  names = tasks.task_names()
  if modules or args.contacts:
    devices.start()
  for module in modules:
    for name in tasks.registered_by(module.__name__):
      tasks.make_task(name)
  if args.contacts:
    from apnpql_jax.tasks.contact_report import contact_report

    return {name: contact_report(tasks.make_task(name)) for name in names}
  return {
    "tasks": names,
    "presets": files.preset_names(),
    "algorithms": list(table_one.ALGORITHMS),
    "backends": list(BACKENDS),
  }
