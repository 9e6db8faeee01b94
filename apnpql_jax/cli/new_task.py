"""The command ``apnpql new-task``: files to start a task from."""

from __future__ import annotations

import dataclasses
import keyword
from pathlib import Path
from typing import Any, ClassVar

import tyro

from apnpql_jax.atomic import check_writable
from apnpql_jax.cli.options import Command
from apnpql_jax.config import files
from apnpql_jax.errors import ConfigError

_TEMPLATES = Path(__file__).resolve().parents[1] / "templates"
_EXAMPLE = "touch_ball"


@dataclasses.dataclass(frozen=True)
class NewTask(Command):
  """Writes the files of a new task: apnpql new-task NAME.

  NAME.py and NAME.xml are a complete task to change: touching a ball.

  apnpql new-task my_task

  apnpql new-task my_task --folder tasks
  """

  uses_jax: ClassVar[bool] = False

  name: tyro.conf.Positional[str] = ""
  """Name of the task: a lower-case letter, then letters, digits and underscores."""

  folder: Path = Path(".")
  """Folder to write to."""


def new_task(args: NewTask) -> dict[str, Any]:
  """Writes the files of a new task and returns their paths.

  Raises:
    ConfigError: The name cannot be used, a file exists, or the folder cannot be
      written.
  """
  if not files.is_name(args.name) or keyword.iskeyword(_camel(args.name)):
    raise ConfigError(
      f"{args.name!r} cannot name a task; use a lower-case letter, then lower-case "
      "letters, digits and underscores: apnpql new-task my_task"
    )
  if args.name in files.preset_names():
    raise ConfigError(f"task {args.name!r} exists; choose another name")
  if f"{args.name}.xml" in files.mjcf_files():
    raise ConfigError(f"scenes include {args.name}.xml; choose another name")
  check_writable(args.folder)
  wanted = {suffix: args.folder / f"{args.name}{suffix}" for suffix in (".py", ".xml")}
  for path in wanted.values():
    if path.exists():
      raise ConfigError(f"{path} exists; choose another name or --folder")
  args.folder.mkdir(parents=True, exist_ok=True)
  for suffix, path in wanted.items():
    text = (_TEMPLATES / f"{_EXAMPLE}{suffix}").read_text(encoding="utf-8")
    for old, new in ((_EXAMPLE, args.name), (_camel(_EXAMPLE), _camel(args.name))):
      text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
  task, scene = map(str, wanted.values())
  return {"task": task, "scene": scene, "next": f"apnpql collect {task}"}


def _camel(name: str) -> str:
  return name.title().replace("_", "")
