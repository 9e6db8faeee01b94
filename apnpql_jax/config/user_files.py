"""Python files that the user names: tasks and presets outside of the package.

A file is executed because its path is on the command line or in a call, never because a
run folder mentions it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import hashlib
import importlib.util
from pathlib import Path
import sys
import traceback
from types import ModuleType

from apnpql_jax.errors import ConfigError, UserError, one_line

_PREFIX = "apnpql_file_"
"""Beginning of the names that the modules of files get."""


def is_file(name: str) -> bool:
  """Returns whether a name given for a task or preset is the path of a Python file."""
  return name.endswith(".py")


def is_loaded(module: str) -> bool:
  """Returns whether a module has a name that ``load`` gives."""
  return module.startswith(_PREFIX)


def loaded() -> list[ModuleType]:
  """Returns the modules of the files that this process has executed."""
  return [module for name, module in sys.modules.items() if is_loaded(name)]


def check_loaded(path: str, task: str) -> None:
  """Raises ``ConfigError`` unless this process has executed the file of a task."""
  if _module_name(Path(path)) not in sys.modules:
    missing = "" if Path(path).is_file() else ", which is missing"
    raise ConfigError(
      f"task {task!r} is in {path}{missing}; a file is executed only if you name it: "
      f"--task-file {path}, or load_preset({path!r}) in Python"
    )


def task_file(argv: Sequence[str]) -> Path | None:
  """Returns the file that ``--task-file`` names on a command line, if any."""
  parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
  parser.add_argument("--task-file", "--task_file", nargs="?", type=Path)
  return parser.parse_known_args(argv)[0].task_file


def load(path: Path | str) -> ModuleType:
  """Executes a Python file, once per process, and returns its module.

  Raises:
    ConfigError: There is no such file, or it fails; the message names the line.
  """
  path = Path(path)
  if not path.is_file():
    raise ConfigError(f"there is no file {str(path)!r}")
  path, name = path.resolve(), _module_name(path)
  if name in sys.modules:
    return sys.modules[name]
  spec = importlib.util.spec_from_file_location(name, path)
  assert spec is not None and spec.loader is not None
  module = sys.modules[name] = importlib.util.module_from_spec(spec)
  try:
    spec.loader.exec_module(module)
  except Exception as error:
    del sys.modules[name]
    reason = one_line(error)
    if not isinstance(error, UserError):
      reason = f"{type(error).__name__}: {reason}"
    raise ConfigError(f"{path}{_line(error, path)} fails with {reason}") from error
  return module


def _module_name(path: Path) -> str:
  path = path.resolve()
  return f"{_PREFIX}{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"


def digest(path: Path | str) -> str | None:
  """Returns a SHA-256 of a task's file and of the MJCF files next to it.

  Returns None if there is no such file.
  """
  path = Path(path)
  if not path.is_file():
    return None
  found = hashlib.sha256(path.read_bytes())
  for mjcf in sorted(path.parent.glob("*.xml")):
    found.update(mjcf.read_bytes())
  return found.hexdigest()


def _line(error: Exception, path: Path) -> str:
  """Returns ":<number>" of the line of the file at which an error arose."""
  if isinstance(error, SyntaxError):
    return f":{error.lineno}"
  frames = traceback.extract_tb(error.__traceback__)
  numbers = [frame.lineno for frame in frames if frame.filename == str(path)]
  return f":{numbers[-1]}" if numbers else ""
