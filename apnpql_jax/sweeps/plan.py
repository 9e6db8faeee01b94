"""Plans of sweeps: the options of every run, from presets, grids and seeds."""

from __future__ import annotations

from collections.abc import Sequence
import itertools
import os
from pathlib import Path
import re
from typing import NamedTuple

from apnpql_jax.config import codec, user_files
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError

_SHORT = {"algorithm": "agent.algorithm", "backend": "env.backend", "obs": "env.obs"}
"""Options of ``apnpql train`` that are short for a setting."""

_PATHS = {"init_from", "replay.demonstrations", "task_file"}
"""Options of ``apnpql train`` that name a file or folder."""


class Planned(NamedTuple):
  """A run to train."""

  name: str  # of its folder in the folder of the sweep
  argv: list[str]  # preset and options of ``apnpql train``


class Axis(NamedTuple):
  """A setting and the values that it takes in a sweep."""

  option: str  # without dashes, such as ``agent.epsilon``
  values: list[str]


def make_plan(
  presets: Sequence[str],
  grid: Sequence[str],
  *,
  seeds: int = 1,
  options: Sequence[str] = (),
) -> list[Planned]:
  """Returns every combination of presets, values and seeds; seeds vary slowest.

  Args:
    presets: Names of presets, or paths of their files.
    grid: Axes as ``option=value,value``. A value of several words, as for
      ``agent.hidden``, has spaces between them.
    seeds: Number of seeds, from 0; an axis ``seed`` names them instead.
    options: Options of ``apnpql train`` that all runs share.

  Raises:
    ConfigError: An axis cannot be read, or two runs would be the same.
  """
  axes = [parse_axis(text) for text in grid]
  names = [_setting(axis.option) for axis in axes]
  given = {_setting(_name(word)) for word in options if word.startswith("--")}
  if twice := sorted(given & {"seed", *names}):
    raise ConfigError(f"give {', '.join(twice)} by --grid {twice[0]}=... alone")
  if repeated := sorted({name for name in names if names.count(name) > 1}):
    raise ConfigError(f"--grid has {', '.join(repeated)} twice; list all values once")
  if "seed" not in names:
    if seeds < 1:
      raise ConfigError(f"--seeds {seeds} must be at least 1")
    axes.append(Axis("seed", [str(seed) for seed in range(seeds)]))
  elif seeds != 1:
    raise ConfigError("use either --seeds or --grid seed=...")
  seed = axes[names.index("seed") if "seed" in names else -1]
  others = [axis for axis in axes if axis is not seed]
  plan = [
    _run(preset, [*zip(others, values, strict=True), (seed, number)], options)
    for number in seed.values
    for preset in presets
    for values in itertools.product(*(axis.values for axis in others))
  ]
  found = [run.name for run in plan]
  if repeated := sorted({name for name in found if found.count(name) > 1}):
    raise ConfigError(f"the plan has {', '.join(repeated)} twice; list each value once")
  return plan


def parse_axis(text: str) -> Axis:
  """Returns an axis such as ``agent.epsilon=0.5,1``.

  Raises:
    ConfigError: It is not written like that.
  """
  option, equals, values = text.partition("=")
  option = _name(option)
  found = [value.strip() for value in values.split(",")]
  if not equals or not option or not all(found):
    raise ConfigError(f"--grid {text!r} is not like agent.epsilon=0.5,1,2")
  return Axis(option, found)


def _name(option: str) -> str:
  """Returns the name of a setting in ``--agent.n-step=2``, or without its value."""
  return option.partition("=")[0].strip().lstrip("-").replace("-", "_")


def _setting(option: str) -> str:
  """Returns the setting of an option, also of one that is short or turns it off."""
  group, dot, last = option.rpartition(".")
  flag = f"{group}{dot}{last.removeprefix('no_')}"
  return flag if _is_flag(flag) else _SHORT.get(option, option)


def _is_flag(setting: str) -> bool:
  return isinstance(dict(codec.flatten(TrainConfig())).get(setting), bool)


def _run(
  preset: str, chosen: Sequence[tuple[Axis, str]], options: Sequence[str]
) -> Planned:
  name = [_plain(Path(preset).stem)]
  path = str(Path(preset).resolve()) if user_files.is_file(preset) else preset
  argv = [path, *_with_absolute_paths(options)]
  for axis, value in chosen:
    short = axis.option.rpartition(".")[2]
    name.append(_plain(f"{short}_{value}"))
    argv += _option(axis.option, value)
  return Planned("-".join(name), argv)


def _option(name: str, value: str) -> list[str]:
  """Returns a setting as options of the command line."""
  dashed = name.replace("_", "-")
  if name in _PATHS:
    return [f"--{dashed}", _absolute(value)]
  if _is_flag(name):
    if value.lower() not in ("true", "false"):
      raise ConfigError(f"--grid {name}={value}: {value!r} is neither true nor false")
    group, dot, last = dashed.rpartition(".")
    return [f"--{dashed}" if value.lower() == "true" else f"--{group}{dot}no-{last}"]
  return [f"--{dashed}", *value.split()]


def _with_absolute_paths(options: Sequence[str]) -> list[str]:
  """Returns options with absolute paths: a sweep may be continued from elsewhere."""
  found, name = [], ""
  for word in options:
    option, equals, value = word.partition("=")
    if word.startswith("--"):
      name = _name(option)
      word = f"{option}={_absolute(value)}" if equals and name in _PATHS else word
    elif name in _PATHS:
      word = _absolute(word)
    found.append(word)
  return found


def _absolute(path: str) -> str:
  """Returns an absolute path; ``RUN:STEP`` keeps its step, and "" means no file."""
  return os.path.abspath(path) if path else ""


def _plain(text: str) -> str:
  """Returns a text with nothing that shells or checkpoints read as patterns."""
  return re.sub(r"[^\w.+-]+", "_", text)
