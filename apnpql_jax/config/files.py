"""Presets, MJCF files and configurations as JSON, in a checkout and in a wheel.

A wheel carries ``experiments/`` and ``mjcf/`` inside the package; in a checkout they
are next to it. Names are plain words, so that a name cannot lead out of its folder.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import importlib.util
import json
from pathlib import Path
import re
from typing import Any

from apnpql_jax.config import codec
from apnpql_jax.config.checks import validate
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import ConfigError, check_name

_PACKAGE = Path(__file__).resolve().parents[1]
_NAME = re.compile(r"[a-z0-9][a-z0-9_]*")


def preset_names() -> list[str]:
  """Returns the sorted names of the presets without executing them."""
  return _names("experiments", ".py")


def load_preset(name: str) -> TrainConfig:
  """Returns the ``CONFIG`` of ``experiments/<name>.py``.

  Raises:
    ConfigError: There is no such preset, or the file defines no TrainConfig.
  """
  check_name("preset", name, preset_names())
  path = _folder("experiments") / f"{name}.py"
  spec = importlib.util.spec_from_file_location(f"apnpql_preset_{name}", path)
  assert spec is not None and spec.loader is not None
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
  """Returns the path of ``mjcf/<name>.xml``.

  Raises:
    ConfigError: There is no such file.
  """
  check_name("MJCF file", name, _names("mjcf", ".xml"))
  return _folder("mjcf") / f"{name}.xml"


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
  return sorted(stem for stem in stems if _NAME.fullmatch(stem))


def _folder(name: str) -> Path:
  inside = _PACKAGE / name
  return inside if inside.is_dir() else _PACKAGE.parent / name
