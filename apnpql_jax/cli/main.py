"""Entry point of ``apnpql``: parses options, runs the command, shows its result."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
import contextlib
import json
import math
import os
from pathlib import Path
import signal
import sys
from typing import Any

from apnpql_jax import __version__, errors, runtime
from apnpql_jax.cli import text
from apnpql_jax.cli.commands import COMMANDS, OPTIONS
from apnpql_jax.cli.options import parse
from apnpql_jax.cli.sweep import Sweep, parse_sweep
from apnpql_jax.cli.train import Train, base_config
from apnpql_jax.config import files, user_files
from apnpql_jax.console import Unfailing, print_line, reporting
from apnpql_jax.errors import ConfigError, UserError, check_name
from apnpql_jax.runs.signals import Signals


def main(argv: Sequence[str] | None = None) -> int:
  """Runs one command line and returns its exit code.

  0 is success, 1 a machine that `doctor` finds unfit, 2 bad input or a failed row of
  `robot check`, 3 a run that had to stop (disk full, non-finite updates), 129 a closed
  terminal, 130 Ctrl-C and 143 SIGTERM; `train` and `sweep` save their runs first. All
  but 0 and 1 print one line to stderr.
  """
  _fill_closed_streams()
  args = list(sys.argv[1:] if argv is None else argv)
  try:
    if not args:
      raise ConfigError(f"name a command: {', '.join(COMMANDS)} (see apnpql --help)")
    if args[0] in ("-h", "--help"):
      _print(_help())
      return 0
    if args[0] == "--version":
      _print(__version__)
      return 0
    check_name("command", args[0], list(COMMANDS))
    kind, command = COMMANDS[args[0]]
    if kind.uses_jax:
      runtime.configure()
      runtime.collect_garbage_less_often()
    parsed = _parse(kind, args)
    with Signals("interrupted"), _json_only(parsed.json) as write:
      result = command(parsed)
      if result:  # Empty in all but the first of several processes.
        with reporting("print the result"):
          write(json.dumps(_plain(result)) if parsed.json else _show(result))
    return result.get("exit_code", 0)
  except (UserError, OSError) as error:  # Errors of the file system name the path.
    print_line(f"apnpql: {' '.join(str(error).split())}")
    return errors.BAD_INPUT
  except errors.RunStopped as stop:
    print_line(f"apnpql: {stop}")
    if stop.code == errors.FAILED:
      # Threads of a failed save may wait for each other for minutes.
      os._exit(stop.code)
    return stop.code
  except KeyboardInterrupt:
    return errors.INTERRUPTED + signal.SIGINT


def _fill_closed_streams() -> None:
  """Opens closed standard streams, whose numbers the next files would get."""
  for number in range(3):
    try:
      os.fstat(number)
    except OSError:
      os.open(os.devnull, os.O_RDWR)  # Takes the lowest free number.


def _parse(kind: type[Any], args: Sequence[str]) -> Any:
  """Returns the options of a command; those of ``train`` override its preset or run."""
  name, *rest = args
  if kind is Sweep:
    return parse_sweep(rest)
  if kind is not Train:
    return parse(kind, name, rest)
  # Parsing ends here for --help, which shows the settings of a preset named before it.
  file = user_files.task_file(rest)
  words = [arg for arg in rest if not arg.startswith("-") and Path(arg) != file]
  default = None
  if preset := next(filter(files.is_preset, words), ""):
    named = Train(preset=preset, task_file=file)
    default = Train(config=base_config(named))
  base = base_config(parse(Train, name, rest, default=default))
  return parse(Train, name, rest, default=Train(config=base))


@contextlib.contextmanager
def _json_only(enabled: bool) -> Generator[Callable[[str], Any], None, None]:
  """Yields a function that prints the result; with JSON, all else goes to stderr.

  Redirects the file descriptor, because libraries print below Python too.
  """
  if not enabled:
    yield _print
    return
  stream = Unfailing(sys.stdout)
  stream.flush()
  stdout = os.dup(1)
  os.dup2(2, 1)
  try:
    yield lambda text: os.write(stdout, (text + "\n").encode())
  finally:
    stream.flush()
    os.dup2(stdout, 1)
    os.close(stdout)


def _print(text: str) -> None:
  """Prints to standard output, at once, so that a failure shows here."""
  try:
    print(text, flush=True)
  except OSError as error:
    # Python tries again at its exit, and would change the exit code.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if not isinstance(error, BrokenPipeError):  # The reader has enough, as `head`.
      print_line(f"cannot print the result: {error}")


def _plain(value: Any) -> Any:
  """Converts a value for JSON: arrays to lists, paths to text, NaN to null."""
  if hasattr(value, "tolist"):  # NumPy and JAX arrays.
    value = value.tolist()
  if isinstance(value, dict):
    return {str(key): _plain(item) for key, item in value.items()}
  if isinstance(value, list | tuple):
    return [_plain(item) for item in value]
  if isinstance(value, float) and not math.isfinite(value):
    return None
  return value if isinstance(value, str | int | float | None) else str(value)


def _show(result: dict[str, Any]) -> str:
  """Returns the result as one line per entry, for people, or its ``text``."""
  if "text" in result:
    return result["text"].rstrip()
  return "\n".join(text.rows((name, _text(x)) for name, x in _rows(result)))


def _rows(result: dict[str, Any]) -> Generator[tuple[str, Any], None, None]:
  """Yields names and values; a dict of dicts or lists has one row for each."""
  for name, value in result.items():
    parts = value.values() if isinstance(value, dict) else ()
    if any(isinstance(part, dict | list) for part in parts):
      yield from ((f"{name} {key}", part) for key, part in value.items())
    else:
      yield name, value


def _text(value: Any) -> str:
  if isinstance(value, dict):
    value = [f"{_number(x)} {name.replace('_', ' ')}" for name, x in value.items()]
  if isinstance(value, list | tuple):
    return ", ".join(map(_number, value)) or "none"
  return _number(value) if isinstance(value, float) else str(value)


def _number(value: Any) -> str:
  if isinstance(value, float):
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"
  return f"{value:,}" if isinstance(value, int) else str(value)


def _help() -> str:
  about = [(f"  {name}", _summary(kind)) for name, kind in OPTIONS.items()]
  lines = ["usage: apnpql COMMAND [options]", "", *text.rows(about), ""]
  return "\n".join([*lines, *text.wrapped("apnpql COMMAND --help shows its options.")])


def _summary(kind: type[Any]) -> str:
  """Returns the first line about a command, without its usage."""
  return (kind.__doc__ or "").splitlines()[0].partition(": apnpql")[0].rstrip(".")
