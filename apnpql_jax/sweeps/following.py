"""Progress of runs that other processes train, read from their metrics."""

from __future__ import annotations

import json
from pathlib import Path

from apnpql_jax.errors import UserError
from apnpql_jax.runs.metrics import STEP, SUCCESS, WALL, Row
from apnpql_jax.runs.run_folder import load_run_config


class Follower:
  """Reader of the rows that a run adds to its metrics."""

  def __init__(self, run_dir: Path):
    """Reads nothing yet; the folder may not exist."""
    self.run_dir = run_dir
    self.success: float | None = None
    self.step = 0.0
    self.total: int | None = None
    self._first: Row = {}
    self._last: Row = {}
    self._read = 0  # bytes

  @property
  def share(self) -> float:
    """Part of the steps that is done, in [0, 1]."""
    return min(1.0, self.step / self.total) if self.total else 0.0

  @property
  def seconds(self) -> float:
    """Wall clock of training."""
    return self._last.get(WALL) or 0.0

  @property
  def left_s(self) -> float | None:
    """Seconds to the last step at the mean speed since the first iteration."""
    steps = self.step - (self._first.get(STEP) or 0.0)
    if steps <= 0 or self.total is None:
      return None
    seconds = self.seconds - (self._first.get(WALL) or 0.0)
    return max(0.0, (self.total - self.step) * seconds / steps)

  def update(self) -> None:
    """Reads what is new. A file that has shrunk was rewritten, and is read again."""
    if self.total is None:
      self.total = _total_steps(self.run_dir)
    path = self.run_dir / "metrics.jsonl"
    try:
      size = path.stat().st_size
      self._read = self._read if size >= self._read else 0
      with path.open("rb") as file:
        file.seek(self._read)
        data = file.read(size - self._read)
    except OSError:
      return
    whole = data[: data.rfind(b"\n") + 1]
    self._read += len(whole)
    lines = whole.splitlines()
    key = json.dumps(SUCCESS).encode()
    wanted = [line for line in lines if key in line]
    for line in [*lines[: not self._first], *wanted, *lines[-1:]]:
      self._take(line)

  def _take(self, line: bytes) -> None:
    try:
      row = json.loads(line)
      step = float(row[STEP])
    except (ValueError, TypeError, KeyError):
      return
    self._first = self._first or row
    if row.get(SUCCESS) is not None:
      self.success = row[SUCCESS]
    self.step, self._last = step, row


def last_line(log: Path) -> str:
  """Returns the last line of a log that is not empty, at most 300 characters of it."""
  try:
    with log.open("rb") as file:
      file.seek(max(0, log.stat().st_size - 8192))
      lines = file.read().decode("utf-8", "replace").split("\n")
  except OSError:
    return ""
  found = [line.strip() for line in lines if line.strip()]
  return found[-1][:300] if found else ""


def _total_steps(run_dir: Path) -> int | None:
  try:
    return load_run_config(run_dir).total_steps
  except UserError:
    return None
