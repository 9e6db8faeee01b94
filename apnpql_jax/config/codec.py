"""Strict conversion between nested dataclasses and JSON; executes nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
import json
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from apnpql_jax.errors import ConfigError

T = TypeVar("T")

_BEFORE = "before"
"""Metadata key of a field: its value in texts written before the field existed."""

_FORMERLY = "formerly"
"""Metadata key of a field: its name in older texts."""


def added(default: Any, *, before: Any = None) -> Any:
  """Returns a dataclass field that older texts may lack.

  ``before`` is its value there, which reproduces the old behavior; ``default`` if None.
  """
  before = default if before is None else before
  return dataclasses.field(default=default, metadata={_BEFORE: before})


def renamed(default: Any, *, formerly: str) -> Any:
  """Returns a dataclass field that ``from_json`` also reads by its former name."""
  return dataclasses.field(default=default, metadata={_FORMERLY: formerly})


def flatten(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
  """Yields (dotted field name, value) of every leaf of a nested dataclass."""
  for field in dataclasses.fields(config):
    value = getattr(config, field.name)
    if dataclasses.is_dataclass(value):
      yield from flatten(value, f"{prefix}{field.name}.")
    else:
      yield prefix + field.name, value


def from_json(cls: type[T], text: str, warn: Callable[[str], None] | None = None) -> T:
  """Parses a nested dataclass, whose JSON may predate some ``added`` fields.

  Calls ``warn`` with one line that lists these fields, if any.

  Raises:
    ConfigError: The text is not JSON, or a key is unknown, missing or of the wrong
      type.
  """
  try:
    data = json.loads(text, parse_constant=_reject_constant)
  except (ValueError, RecursionError) as error:
    raise ConfigError(f"config is not valid JSON: {str(error)[:200]}") from None
  missing: list[str] = []
  config = _build(cls, data, "", missing)
  if missing and warn:
    names = ", ".join(missing)
    warn(f"older than some settings, which keep their old behavior: {names}")
  return config


def _build(cls: type[Any], data: Any, path: str, missing: list[str]) -> Any:
  """Returns a dataclass built from parsed JSON, with every key accounted for.

  Appends the ``added`` fields that ``data`` lacks to ``missing``.
  """
  if not isinstance(data, dict):
    raise ConfigError(f"config field {path or 'top level'} must be an object")
  prefix = path + "." if path else ""
  hints = get_type_hints(cls)
  new_names = {f.metadata.get(_FORMERLY): f.name for f in dataclasses.fields(cls)}
  data = {new_names.get(key, key): value for key, value in data.items()}
  for key in data:
    if key not in hints:
      raise ConfigError(
        f"unknown config field {prefix + key!r}; valid: {', '.join(hints)}"
      )
  values = {}
  for field in dataclasses.fields(cls):
    key, name = field.name, prefix + field.name
    if key in data:
      values[key] = _value(hints[key], data[key], name, missing)
    elif _BEFORE in field.metadata:
      values[key] = before = field.metadata[_BEFORE]
      group = dataclasses.is_dataclass(before)
      missing.append(name if group else f"{name} {before}")
    else:
      raise ConfigError(f"config field {name!r} is missing")
  return cls(**values)


def _value(hint: Any, value: Any, path: str, missing: list[str]) -> Any:
  if dataclasses.is_dataclass(hint) and isinstance(hint, type):
    return _build(hint, value, path, missing)
  if get_origin(hint) is tuple and isinstance(value, list):
    return tuple(_value(get_args(hint)[0], item, path, missing) for item in value)
  # Some JSON writers drop the point of a whole float, so an int is read as one. A bool,
  # an int to Python, is rejected.
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


def _reject_constant(name: str) -> float:
  raise ValueError(f"{name} is not a number")
