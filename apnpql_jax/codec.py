"""Nested frozen dataclasses to JSON and back, strictly and as data only.

Knows nothing of what the fields mean; ``config`` holds the dataclasses themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import json
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")


class ConfigError(ValueError):
  """A setting that cannot work; its one-line message says what to write instead."""


def flatten(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
  """Yields (dotted field name, value) of every leaf of a nested dataclass."""
  for field in dataclasses.fields(config):
    value = getattr(config, field.name)
    if dataclasses.is_dataclass(value):
      yield from flatten(value, f"{prefix}{field.name}.")
    else:
      yield prefix + field.name, value


def to_json(config: Any) -> str:
  """The dataclass as indented JSON text, nested as it is."""
  return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(cls: type[T], text: str) -> T:
  """Reads what ``to_json`` wrote; only data, nothing is executed.

  Raises:
    ConfigError: not JSON, or a key is unknown, missing, or of the wrong type.
  """
  try:
    data = json.loads(text, parse_constant=_refuse_constant)
  except (ValueError, RecursionError) as error:
    raise ConfigError(f"config is not valid JSON: {str(error)[:200]}") from None
  return _build(cls, data, "")


def _build(cls: type[T], data: Any, path: str) -> T:
  """An instance of dataclass ``cls`` from parsed JSON, every key accounted for."""
  if not isinstance(data, dict):
    raise ConfigError(f"config field {path or 'top level'} must be an object")
  prefix = path + "." if path else ""
  hints = get_type_hints(cls)
  for key in data:
    if key not in hints:
      raise ConfigError(
        f"unknown config field {prefix + key!r}; valid: {', '.join(hints)}"
      )
  for key in hints:
    if key not in data:
      raise ConfigError(f"config field {prefix + key!r} is missing")
  return cls(**{k: _value(hints[k], v, prefix + k) for k, v in data.items()})


def _value(hint: Any, value: Any, path: str) -> Any:
  if dataclasses.is_dataclass(hint) and isinstance(hint, type):
    return _build(hint, value, path)
  if get_origin(hint) is tuple and isinstance(value, list):
    return tuple(_value(get_args(hint)[0], item, path) for item in value)
  # bool is an int to Python, and a whole float is written without its point by
  # other JSON writers: the first is refused, the second is read.
  if hint is float and type(value) is int:
    try:
      return float(value)
    except OverflowError:
      raise ConfigError(f"config field {path!r} is too large") from None
  if type(value) is not hint:
    name = "a list" if get_origin(hint) is tuple else hint.__name__
    raise ConfigError(
      f"config field {path!r} must be {name}, not {type(value).__name__}"
    )
  return value


def _refuse_constant(name: str) -> float:
  raise ValueError(f"{name} is not a number")
