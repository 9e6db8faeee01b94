"""Nested frozen dataclasses to JSON and back, strictly and as data only.

Knows nothing of what the fields mean; ``config`` holds the dataclasses themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
import json
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from apnpql_jax.errors import ConfigError

T = TypeVar("T")

_BEFORE = "before"
"""In the metadata of a field: its value in texts that were written without it."""


_FORMERLY = "formerly"
"""In the metadata of a field: its name in older texts."""


def added(default: Any, *, before: Any = None) -> Any:
  """A field that came when texts without it existed.

  Args:
    default: its default.
    before: the value that means what was done without it; the default if None.
  """
  before = default if before is None else before
  return dataclasses.field(default=default, metadata={_BEFORE: before})


def renamed(default: Any, *, formerly: str) -> Any:
  """A field that had another name in older texts.

  Args:
    default: its default.
    formerly: the name that ``from_json`` still accepts.
  """
  return dataclasses.field(default=default, metadata={_FORMERLY: formerly})


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


def unsaid(line: str) -> None:
  """For those who do not want to be told."""


def from_json(cls: type[T], text: str, say: Callable[[str], None] = unsaid) -> T:
  """Reads what ``to_json`` wrote; only data, nothing is executed.

  Args:
    cls: the dataclass.
    text: may have been written before the fields that are ``added``.
    say: is told in one line which these are, if any.

  Raises:
    ConfigError: not JSON, or a key is unknown, missing, or of the wrong type.
  """
  try:
    data = json.loads(text, parse_constant=_refuse_constant)
  except (ValueError, RecursionError) as error:
    raise ConfigError(f"config is not valid JSON: {str(error)[:200]}") from None
  lacking: list[str] = []
  config = _build(cls, data, "", lacking)
  if lacking:
    say(f"older than some settings, which are as before: {', '.join(lacking)}")
  return config


def _build(cls: type[Any], data: Any, path: str, lacking: list[str]) -> Any:
  """An instance of dataclass ``cls`` from parsed JSON, every key accounted for.

  Appends to ``lacking`` the fields that are missing for good reason.
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
      values[key] = _value(hints[key], data[key], name, lacking)
    elif _BEFORE in field.metadata:
      values[key] = before = field.metadata[_BEFORE]
      group = dataclasses.is_dataclass(before)
      lacking.append(name if group else f"{name} {before}")
    else:
      raise ConfigError(f"config field {name!r} is missing")
  return cls(**values)


def _value(hint: Any, value: Any, path: str, lacking: list[str]) -> Any:
  if dataclasses.is_dataclass(hint) and isinstance(hint, type):
    return _build(hint, value, path, lacking)
  if get_origin(hint) is tuple and isinstance(value, list):
    return tuple(_value(get_args(hint)[0], item, path, lacking) for item in value)
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
