"""The table of a check: rows by name, some of which may fail."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
from typing import Any, TypeVar

from apnpql_jax.console import print_line
from apnpql_jax.errors import NOT_READY, UserError, one_line

T = TypeVar("T")


class Table:
  """Rows in the order in which they are set."""

  def __init__(self) -> None:
    """Begins without rows."""
    self.rows: dict[str, str] = {}
    self.failing: list[str] = []

  def fail(self, name: str, problem: str) -> None:
    """Sets a row that fails, or adds a new problem to one that does."""
    problem = problem.removeprefix(f"{name}: ")
    if name not in self.failing:
      self.failing.append(name)
      self.rows[name] = f"FAILS: {problem}"
    elif problem not in self.rows[name]:
      self.rows[name] += f"; {problem}"

  @contextlib.contextmanager
  def row(self, name: str) -> Generator[None]:
    """Turns an error for the user into a row that fails."""
    try:
      yield
    except UserError as error:
      self.fail(name, one_line(error))

  def guarded(self, name: str, read: Callable[[], T], instead: T) -> Callable[[], T]:
    """Wraps ``read``: if it fails, the row fails and ``instead`` is returned."""

    def call() -> T:
      with self.row(name):
        return read()
      return instead

    return call

  def result(self) -> dict[str, Any]:
    """Returns the rows, and if some fail, their names and the exit code."""
    if not self.failing:
      return dict(self.rows)
    print_line(f"apnpql: not ready: {', '.join(self.failing)}")
    return {**self.rows, "not_ready": self.failing, "exit_code": NOT_READY}
