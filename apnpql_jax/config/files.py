"""Presets, MJCF files and configurations as JSON, in a checkout and in a wheel.

A wheel carries ``experiments/`` and ``mjcf/`` inside the package; in a checkout they
are next to it. Names are plain words, so that a name cannot lead out of its folder.

Presets also come from files that the user names, and from installed packages, whose
entry points in the group ``apnpql.presets`` refer to a ``TrainConfig``.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from importlib import metadata
import json
from pathlib import Path
import re
from types import ModuleType
from typing import Any

from apnpql_jax.config import codec, user_files
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.errors import ConfigError, check_name, one_line

_PACKAGE = Path(__file__).resolve().parents[1]
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def preset_names() -> list[str]:
  """Returns the sorted names of the presets without executing them."""
  return sorted({*own_preset_names(), *_installed()})


def own_preset_names() -> list[str]:
  """Returns the names of the presets of this package."""
  return _names("experiments", ".py")


def is_preset(name: str) -> bool:
  """Returns whether ``load_preset`` would look for a preset of this name or path."""
  return user_files.is_file(name) or name in preset_names()


def load_preset(name: str) -> TrainConfig:
  """Returns the settings of a preset.

  Args:
    name: A name in ``preset_names``, or the path of a Python file that defines
      ``CONFIG`` and may register the task.

  Raises:
    ConfigError: There is no such preset, or it defines no TrainConfig.
  """
  if user_files.is_file(name):
    module = user_files.load(name)
    return with_file(module, _checked(name, getattr(module, "CONFIG", None)))
  check_name("preset", name, preset_names())
  if name in own_preset_names():
    module = user_files.load(_folder("experiments") / f"{name}.py")
    return _checked(name, getattr(module, "CONFIG", None))
  try:
    return _checked(name, _installed()[name].load())
  except Exception as error:
    reason = f"{type(error).__name__}: {one_line(error)}"
    raise ConfigError(f"preset {name!r} fails with {reason}") from error


def with_file(module: ModuleType, config: TrainConfig) -> TrainConfig:
  """Returns settings that name the file of a module if it has their task."""
  classes = (value for value in vars(module).values() if isinstance(value, type))
  if config.env.task not in (getattr(value, "name", None) for value in classes):
    return config
  env = dataclasses.replace(config.env, task_file=module.__file__)
  return dataclasses.replace(config, env=env)


def _checked(name: str, config: Any) -> TrainConfig:
  if not isinstance(config, TrainConfig):
    raise ConfigError(f"preset {name!r} must define CONFIG = TrainConfig(...)")
  return config


@functools.cache
def _installed() -> dict[str, metadata.EntryPoint]:
  """Returns the presets of other installed packages, by name."""
  return {point.name: point for point in metadata.entry_points(group="apnpql.presets")}


def preset_tasks() -> list[str]:
  """Returns the sorted names of the tasks that have a preset of their own.

  An installed package has one if the entry points of its task and preset have one name.
  """
  installed = metadata.entry_points(group="apnpql.tasks").names
  tasks = {*_names("mjcf", ".xml"), *filter(is_name, installed)}
  return [name for name in preset_names() if name in tasks]


def task_env(task: str) -> EnvConfig:
  """Returns ``task_preset(task).env``."""
  return task_preset(task).env


def task_preset(task: str) -> TrainConfig:
  """Returns the preset of a task, or the default settings with the task.

  Args:
    task: The name of a task, or the path of its file. The preset of a name may come
      from a file that this process has executed.

  Raises:
    ConfigError: See ``load_preset``.
  """
  if user_files.is_file(task):
    return load_preset(task)
  config = load_preset(task) if task in preset_names() else _executed(task)
  return dataclasses.replace(config, env=dataclasses.replace(config.env, task=task))


def _executed(task: str) -> TrainConfig:
  """Returns the preset next to a task of the user's; the defaults if there is none."""
  for module in user_files.loaded():
    config = getattr(module, "CONFIG", None)
    if isinstance(config, TrainConfig) and config.env.task == task:
      config = with_file(module, config)
      if config.env.task_file:
        return config
  return TrainConfig()


def is_name(text: str) -> bool:
  """Returns whether a preset, task or MJCF file of the package could have this name."""
  return _NAME.fullmatch(text) is not None


def mjcf_path(name: str) -> Path:
  """Returns the path of ``mjcf/<name>.xml``.

  Raises:
    ConfigError: There is no such file.
  """
  check_name("MJCF file", name, _names("mjcf", ".xml"))
  return _folder("mjcf") / f"{name}.xml"


def mjcf_files() -> dict[str, bytes]:
  """Returns name -> content of the package's MJCF files."""
  folder = _folder("mjcf")
  return {
    f"{n}.xml": (folder / f"{n}.xml").read_bytes() for n in _names("mjcf", ".xml")
  }


def config_to_json(config: TrainConfig) -> str:
  """Returns the configuration as indented JSON, nested like the dataclasses."""
  return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def config_from_json(
  text: str, warn: Callable[[str], None] | None = None
) -> TrainConfig:
  """Parses and validates the output of ``config_to_json``; see ``codec.from_json``.

  Raises:
    ConfigError: The text cannot be parsed, or a setting is invalid.
  """
  config = codec.from_json(TrainConfig, text, warn)
  validate(config)
  return config


def config_diff(a: TrainConfig, b: TrainConfig) -> dict[str, tuple[Any, Any]]:
  """Returns dotted field name -> (value in ``a``, value in ``b``) where they differ."""
  other = dict(codec.flatten(b))
  return {k: (v, other[k]) for k, v in codec.flatten(a) if v != other[k]}


def format_diff(diff: dict[str, tuple[Any, Any]]) -> str:
  """Returns one line such as ``agent.gamma 0.99 -> 0.95, seed 0 -> 1``."""
  return ", ".join(f"{name} {a} -> {b}" for name, (a, b) in diff.items())


def _names(folder: str, suffix: str) -> list[str]:
  stems = (path.stem for path in _folder(folder).glob(f"*{suffix}"))
  return sorted(stem for stem in stems if is_name(stem))


def _folder(name: str) -> Path:
  inside = _PACKAGE / name
  return inside if inside.is_dir() else _PACKAGE.parent / name
