"""The table of a check: rows by name, some of which may fail."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
from typing import Any

from apnpql_jax.console import print_line
from apnpql_jax.errors import UserError, one_line
from apnpql_jax.robot import devices

NOT_READY = 2
"""Exit code if a row fails."""


class Table:
  """Rows in the order in which they are set."""

  def __init__(self) -> None:
    """Begins without rows."""
    self.rows: dict[str, str] = {}
    self.failing: list[str] = []

  def fail(self, name: str, problem: str) -> None:
    """Sets a row that fails, or adds a problem to one that does."""
    if name in self.failing:
      self.rows[name] += f"; {problem}"
      return
    self.rows[name] = f"FAILS: {problem}"
    self.failing.append(name)

  @contextlib.contextmanager
  def row(self, name: str) -> Generator[None]:
    """Turns an error for the user into a row that fails."""
    try:
      with devices.needing_packages():
        yield
    except UserError as error:
      self.fail(name, one_line(error))

  def result(self) -> dict[str, Any]:
    """Returns the rows, and if some fail, their names and the exit code."""
    if not self.failing:
      return dict(self.rows)
    print_line(f"apnpql: not ready: {', '.join(self.failing)}")
    return {**self.rows, "not_ready": self.failing, "exit_code": NOT_READY}
