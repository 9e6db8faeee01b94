"""Errors with one-line messages for the user, and exit codes of runs."""

from __future__ import annotations

from collections.abc import Sequence

INTERRUPTED = 128
"""Exit code of a run stopped by a signal, to which the signal number is added."""

FAILED = 3
"""Exit code of a run that stopped on an error: disk full or values not finite."""


class UserError(Exception):
  """A request that cannot be met; the one-line message names the fix."""


class ConfigError(UserError, ValueError):
  """An invalid setting; the message says what to write instead."""


class FileError(UserError):
  """A file or folder that is damaged, foreign, locked or inaccessible."""


class RunStopped(Exception):
  """An orderly stop of a run before its last step; the one-line message says why."""

  def __init__(self, message: str, code: int):
    """Stores the exit code: ``FAILED``, or ``INTERRUPTED`` plus a signal number."""
    super().__init__(message)
    self.code = code


def one_line(error: BaseException) -> str:
  """Returns the message of an exception as one line of at most 200 characters."""
  return " ".join(str(error).split())[:200] or type(error).__name__


def check_name(field: str, value: str, valid: Sequence[str]) -> None:
  """Checks that ``value`` is one of the valid choices.

  Raises:
    ConfigError: It is not; the message lists the choices.
  """
  if value not in valid:
    raise ConfigError(f"unknown {field} {value!r}; choose from {', '.join(valid)}")
