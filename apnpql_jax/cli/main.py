"""The command ``apnpql``: parses, calls, and shows results and errors, no more."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
import contextlib
import json
import math
import os
import signal
import sys
from typing import Any

from apnpql_jax import errors, runtime
from apnpql_jax.cli import commands
from apnpql_jax.cli.commands import Json
from apnpql_jax.cli.options import (
  Collect,
  Convert,
  Evaluate,
  List,
  Repeat,
  Train,
  parse,
)
from apnpql_jax.config import files
from apnpql_jax.console import say
from apnpql_jax.errors import ConfigError, UserError, check_name
from apnpql_jax.runs.signals import Signals
from apnpql_jax.version import __version__


def main(argv: Sequence[str] | None = None) -> int:
  """Runs one command line; returns the exit code.

  0 success; 2 bad input; 3 a run that had to stop (disk full, values not finite); 130
  Ctrl-C and 143 SIGTERM, with a run saved. All but 0 with one line on standard error.
  """
  runtime.configure()
  args = list(sys.argv[1:] if argv is None else argv)
  try:
    if not args:
      raise ConfigError(f"name a command: {', '.join(_COMMANDS)} (see apnpql --help)")
    if args[0] in ("-h", "--help"):
      print(_help())
      return 0
    if args[0] == "--version":
      print(__version__)
      return 0
    check_name("command", args[0], list(_COMMANDS))
    kind, command, show = _COMMANDS[args[0]]
    parsed = parse(kind, args[0], args[1:], default=_preset_named(kind, args))
    with Signals("interrupted"), _only_json(parsed.json) as write:
      result = command(parsed, args[1:])
      if result:  # Of several processes, the first one tells.
        write(_to_json(result) if parsed.json else show(result))
    return 0
  except UserError as error:
    say(f"apnpql: {' '.join(str(error).split())}")
    return 2
  except errors.RunStopped as stop:
    say(f"apnpql: {stop}")
    if stop.code == errors.FAILED:
      # Threads of a save that failed half-way may wait for each other for minutes.
      os._exit(stop.code)
    return stop.code
  except KeyboardInterrupt:
    return errors.INTERRUPTED + signal.SIGINT
  except BrokenPipeError:  # The reader of our output left, as `head` does.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return 0


def _preset_named(kind: type[Any], args: Sequence[str]) -> Train | None:
  """The defaults that ``train PRESET --help`` has to show."""
  named = [arg for arg in args if arg in files.preset_names()]
  if kind is not Train or not named:
    return None
  return Train(config=files.load_preset(named[0]))


@contextlib.contextmanager
def _only_json(enabled: bool) -> Generator[Callable[[str], Any], None, None]:
  """Yields how to write the result; with JSON, all other output goes to stderr.

  The file descriptor itself is redirected, because libraries below Python print too.
  """
  if not enabled:
    yield print
    return
  sys.stdout.flush()
  stdout = os.dup(1)
  os.dup2(2, 1)
  try:
    yield lambda text: os.write(stdout, (text + "\n").encode())
  finally:
    sys.stdout.flush()
    os.dup2(stdout, 1)
    os.close(stdout)


def _to_json(result: Json) -> str:
  return json.dumps(_plain(result), allow_nan=False)


def _plain(value: Any) -> Any:
  """``value`` as JSON can hold it: arrays as lists, paths as text, NaN as null."""
  if hasattr(value, "tolist"):  # numpy, JAX
    value = value.tolist()
  if isinstance(value, dict):
    return {str(key): _plain(item) for key, item in value.items()}
  if isinstance(value, list | tuple):
    return [_plain(item) for item in value]
  if isinstance(value, float) and not math.isfinite(value):
    return None
  return value if isinstance(value, str | int | float | None) else str(value)


def _show_figures(result: Json) -> str:
  width = max(map(len, result), default=0)
  return "\n".join(f"{name:<{width}}  {value}" for name, value in result.items())


def _show_names(result: Json) -> str:
  width = max(map(len, result))
  lines = []
  for kind, names in result.items():
    if isinstance(names, dict):  # A contact report.
      names = [
        f"{value:,.0f} {name.replace('_', ' ')}" for name, value in names.items()
      ]
    lines.append(f"{kind:<{width}}  {', '.join(names)}")
  return "\n".join(lines)


def _help() -> str:
  lines = ["usage: apnpql COMMAND [options]", ""]
  for name, (kind, _, _) in _COMMANDS.items():
    lines.append(f"  {name:<9} {(kind.__doc__ or '').splitlines()[0]}")
  lines += ["", "apnpql COMMAND --help shows its options."]
  return "\n".join(lines)


_COMMANDS: dict[str, tuple[type[Any], Callable[[Any, Sequence[str]], Json], Any]] = {
  "train": (Train, commands.train, _show_figures),
  "evaluate": (Evaluate, commands.evaluate, _show_figures),
  "collect": (Collect, commands.collect, _show_figures),
  "convert": (Convert, commands.convert, _show_figures),
  "repeat": (Repeat, commands.repeat, _show_figures),
  "list": (List, commands.list_names, _show_names),
}
