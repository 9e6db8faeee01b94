"""Finds presets and MJCF files by name, in a checkout and in an installed wheel.

A wheel carries ``experiments/`` and ``mjcf/`` inside the package; in a checkout they
lie beside it. Names are plain words, so that a name can never leave the folder.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib.util
from pathlib import Path
import re
from typing import Any

from apnpql_jax.config import codec
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError, check_name

_PACKAGE = Path(__file__).resolve().parents[1]
_NAME = re.compile(r"[a-z0-9_]+")


def preset_names() -> list[str]:
  """Names of the presets, sorted; found by listing files, nothing is executed."""
  return _names("experiments", ".py")


def load_preset(name: str) -> TrainConfig:
  """The ``CONFIG`` of ``experiments/<name>.py``.

  Raises:
    ConfigError: no such preset, or the file does not define a TrainConfig.
  """
  check_name("preset", name, preset_names())
  path = _folder("experiments") / f"{name}.py"
  spec = importlib.util.spec_from_file_location(f"apnpql_preset_{name}", path)
  if spec is None or spec.loader is None:
    raise ConfigError(f"preset {name!r} cannot be read from {path}")
  module = importlib.util.module_from_spec(spec)
  try:
    spec.loader.exec_module(module)
  except Exception as error:
    raise ConfigError(
      f"preset {name!r} fails with {type(error).__name__}: {error}"
    ) from error
  config = getattr(module, "CONFIG", None)
  if not isinstance(config, TrainConfig):
    raise ConfigError(f"preset {name!r} must define CONFIG = TrainConfig(...)")
  return config


def mjcf_path(name: str) -> Path:
  """Path of ``mjcf/<name>.xml``.

  Raises:
    ConfigError: no such file.
  """
  check_name("MJCF file", name, _names("mjcf", ".xml"))
  return _folder("mjcf") / f"{name}.xml"


def config_to_json(config: TrainConfig) -> str:
  """The configuration as indented JSON text, nested like the dataclasses."""
  return codec.to_json(config)


def config_from_json(
  text: str, say: Callable[[str], None] = codec.unsaid
) -> TrainConfig:
  """Reads and validates what ``config_to_json`` wrote; nothing is executed.

  Args:
    text: the configuration.
    say: is told in one line which settings came after it was written, if any.

  Raises:
    ConfigError: not JSON, a key unknown, missing or of the wrong type, or a
      setting that cannot work.
  """
  config = codec.from_json(TrainConfig, text, say)
  validate(config)
  return config


def config_diff(a: TrainConfig, b: TrainConfig) -> dict[str, tuple[Any, Any]]:
  """Dotted field name -> (value in ``a``, value in ``b``) where the two differ."""
  other = dict(codec.flatten(b))
  return {k: (v, other[k]) for k, v in codec.flatten(a) if v != other[k]}


def format_diff(diff: dict[str, tuple[Any, Any]]) -> str:
  """One line such as ``agent.gamma 0.99 -> 0.95, seed 0 -> 1``."""
  return ", ".join(f"{name} {a} -> {b}" for name, (a, b) in diff.items())


def _names(folder: str, suffix: str) -> list[str]:
  stems = (path.stem for path in _folder(folder).glob(f"*{suffix}"))
  return sorted(stem for stem in stems if _is_name(stem))


def _is_name(stem: str) -> bool:
  return bool(_NAME.fullmatch(stem)) and not stem.startswith("_")


def _folder(name: str) -> Path:
  inside = _PACKAGE / name
  return inside if inside.is_dir() else _PACKAGE.parent / name
