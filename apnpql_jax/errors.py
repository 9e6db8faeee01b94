"""Errors with a one-line message for the user, and the exit codes of runs."""

from __future__ import annotations

from collections.abc import Sequence

INTERRUPTED = 128
"""Exit code of a run stopped by a signal, plus the number of the signal."""

FAILED = 3
"""Exit code of a run that stopped by itself: disk full, or values not finite."""


class UserError(Exception):
  """A request that cannot be served; the one-line message names the cure."""


class ConfigError(UserError, ValueError):
  """A setting that cannot work; the message says what to write instead."""


class FileError(UserError):
  """A file or folder that cannot be used: damaged, foreign, locked or out of reach."""


class RunStopped(Exception):
  """A run that ended before its last step, in order; the one-line message says why."""

  def __init__(self, message: str, code: int):
    """Keeps the exit code, ``INTERRUPTED`` plus a signal or ``FAILED``."""
    super().__init__(message)
    self.code = code


def one_line(error: BaseException) -> str:
  """Returns the message of an exception as one line of at most 200 characters."""
  return " ".join(str(error).split())[:200] or type(error).__name__


def check_name(field: str, value: str, valid: Sequence[str]) -> None:
  """Checks that ``value`` is one of the valid choices.

  Raises:
    ConfigError: it is not; the message lists the choices.
  """
  if value not in valid:
    raise ConfigError(f"unknown {field} {value!r}; choose from {', '.join(valid)}")
