"""Errors with one-line messages for the user, and exit codes of runs."""

from __future__ import annotations

from collections.abc import Sequence

UNWELL = 1  # exit code of a check that found something that must be changed
INTERRUPTED = 128  # plus the signal number: exit code of a run stopped by a signal
BAD_INPUT = 2  # exit code of bad input, or of a file that cannot be read or written
NOT_READY = 2  # exit code of a robot check in which a row fails
FAILED = 3  # exit code of a run that an error stopped, as a full disk or a lost device


class UserError(Exception):
  """A request that cannot be met; the one-line message names the fix."""


class ConfigError(UserError, ValueError):
  """An invalid setting; the message names a valid one."""


class FileError(UserError):
  """A file or folder that is damaged, foreign, locked or inaccessible."""


class DeviceError(UserError):
  """A device of the robot that is missing, silent, or another one than expected."""


class RunStopped(Exception):
  """An orderly stop of a run before its last step, with a one-line reason."""

  def __init__(self, message: str, code: int):
    """Stores the exit code: ``FAILED``, or ``INTERRUPTED`` plus a signal number."""
    super().__init__(message)
    self.code = code


def one_line(error: BaseException) -> str:
  """Returns the message of an exception as one line of at most 200 characters."""
  return " ".join(str(error).split())[:200] or type(error).__name__


def reason(error: BaseException) -> str:
  """Returns an exception as one line; with its type unless it is for the user."""
  if isinstance(error, UserError):
    return one_line(error)
  return f"{type(error).__name__}: {one_line(error)}"


def check_name(field: str, value: str, valid: Sequence[str]) -> None:
  """Raises ``ConfigError``, which lists the choices, unless ``value`` is valid."""
  if value not in valid:
    raise ConfigError(f"unknown {field} {value!r}; choose from {', '.join(valid)}")
