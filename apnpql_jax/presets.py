"""Finds presets and MJCF files by name, in a checkout and in an installed wheel.

A wheel carries ``experiments/`` and ``mjcf/`` inside the package; in a checkout they
lie beside it. Names are plain words, so that a name can never leave the folder.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
import re

from apnpql_jax.config import ConfigError, TrainConfig, check_name

_PACKAGE = Path(__file__).resolve().parent
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


def _names(folder: str, suffix: str) -> list[str]:
  stems = (path.stem for path in _folder(folder).glob(f"*{suffix}"))
  return sorted(stem for stem in stems if _is_name(stem))


def _is_name(stem: str) -> bool:
  return bool(_NAME.fullmatch(stem)) and not stem.startswith("_")


def _folder(name: str) -> Path:
  inside = _PACKAGE / name
  return inside if inside.is_dir() else _PACKAGE.parent / name
