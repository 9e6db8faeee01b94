"""Metrics of a run: the rows of ``metrics.jsonl``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import json
import math
from pathlib import Path
import shutil
import time
from typing import Any, Protocol

from apnpql_jax.console import print_line, reporting
from apnpql_jax.errors import FileError, one_line
from apnpql_jax.runs.text import write_text

STEP = "step"  # environment steps, summed over worlds; in every row
WALL = "time/wall_s"  # seconds of training, including those before a resume
SUCCESS = "eval/success_rate"
EPISODES = "eval/episodes"

MAX_BYTES = 32 << 20
"""Size above which ``metrics.jsonl`` is renamed to ``metrics.<n>.jsonl``."""

Row = dict[str, float | None]


class Sink(Protocol):
  """An additional destination for metrics."""

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """Receives the metrics of one step."""

  def close(self) -> None:
    """Flushes what is still buffered."""


class MetricWriter:
  """Writer of ``metrics.jsonl``; each row is on disk when ``write`` returns.

  A file that has grown too large is renamed to ``metrics.<n>.jsonl``, starting at 1.
  """

  def __init__(
    self,
    run_dir: Path,
    *,
    resume_step: int | None = None,
    sinks: Sequence[Sink] = (),
    clock: Callable[[], float] = time.monotonic,
    max_bytes: int = MAX_BYTES,
  ):
    """Opens the file and keeps its rows, except those after ``resume_step``.

    Lines that cannot be read are left out, and a copy of the file is kept. The sinks
    are closed together with this writer.
    """
    self._path = run_dir / "metrics.jsonl"
    self._sinks, self._clock, self._max_bytes = list(sinks), clock, max_bytes
    rows = self._rows_until(resume_step)
    # Rewritten, because a killed process may have left half a line.
    write_text(self._path, "".join(_json_line(row) for row in rows))
    self._start = clock() - ((rows[-1].get(WALL) or 0.0) if rows else 0.0)

  def write(self, step: int, metrics: Mapping[str, Any]) -> None:
    """Adds a row of numbers or arrays of one element.

    Non-finite values become null in the file.
    """
    numbers = {name: _number(value) for name, value in metrics.items()}
    row: Row = {STEP: step, WALL: round(self._clock() - self._start, 3), **numbers}
    with self._path.open("a", encoding="utf-8") as file:
      file.write(_json_line(row))
    if self._path.stat().st_size > self._max_bytes:
      self._path.rename(_numbered(self._path, len(metric_files(self._path.parent))))
    for sink in self._sinks[:]:
      try:
        sink.write(step, numbers)
      except Exception as error:  # Whatever its library raises.
        print_line(f"a metric sink failed and gets no more rows: {one_line(error)}")
        self._sinks.remove(sink)

  def close(self) -> None:
    """Closes the sinks; the file is always complete."""
    for sink in self._sinks:
      with reporting("close a metric sink"):
        sink.close()

  def __enter__(self) -> MetricWriter:
    return self

  def __exit__(self, *exception: object) -> None:
    self.close()

  def _rows_until(self, step: int | None) -> list[Row]:
    """Returns the rows up to ``step`` of the newest file that has any.

    That file becomes ``metrics.jsonl`` again.
    """
    rows = self._readable()
    if step is None:
      return rows
    kept = [row for row in rows if (row[STEP] or 0) <= step]
    if not kept and (number := len(metric_files(self._path.parent)) - 1) > 0:
      _numbered(self._path, number).replace(self._path)
      return self._rows_until(step)
    return kept

  def _readable(self) -> list[Row]:
    """Returns the rows of the file that can be read; keeps a copy if some cannot."""
    try:
      return read_rows(self._path)
    except FileError as error:
      copy = self._path.with_suffix(".damaged.jsonl")
      shutil.copyfile(self._path, copy)
      print_line(f"{error}; left out, and the whole file is kept as {copy.name}")
      return read_rows(self._path, skip_damaged=True)


def metric_files(run_dir: Path) -> list[Path]:
  """Returns the metric files of a run, oldest first; the last may not exist."""
  current, renamed = run_dir / "metrics.jsonl", []
  while (path := _numbered(current, len(renamed) + 1)).exists():
    renamed.append(path)
  return [*renamed, current]


def read_evaluations(run_dir: Path) -> list[Row]:
  """Returns the rows of all evaluations of a run, oldest first."""
  key = json.dumps(SUCCESS)
  while True:
    files = metric_files(run_dir)
    rows = [row for path in files for row in read_rows(path, having=key)]
    if metric_files(run_dir) == files:  # A run that is training renames them.
      return [row for row in rows if row.get(SUCCESS) is not None]


def _numbered(path: Path, number: int) -> Path:
  return path.with_suffix(f".{number}{path.suffix}")


def read_rows(path: Path, *, having: str = "", skip_damaged: bool = False) -> list[Row]:
  """Returns the rows of a metric file, oldest first; none if there is no file.

  Skips lines without the text ``having``, so that the few evaluations of a long run are
  read without parsing all of its rows.

  Raises:
    FileError: A line other than an incomplete last one is not a row, and
      ``skip_damaged`` is not set.
  """
  try:
    opened = path.open(encoding="utf-8", errors="replace")
  except FileNotFoundError:
    return []
  rows = []
  with opened as file:
    for number, line in enumerate(file, start=1):
      if not line.endswith("\n"):
        break
      if having not in line:
        continue
      try:
        row = json.loads(line)
        row[STEP] + sum(x for x in row.values() if x is not None)
      except (ValueError, TypeError, KeyError, AttributeError):
        if skip_damaged:
          continue
        raise FileError(f"{path}, line {number}: not a row of metrics") from None
      rows.append(row)
  return rows


def _number(value: Any) -> float:
  value = value.item() if hasattr(value, "item") else value
  return int(value) if isinstance(value, int) else float(value)


def _json_line(row: Row) -> str:
  finite = {
    k: x if x is not None and math.isfinite(x) else None for k, x in row.items()
  }
  return json.dumps(finite, allow_nan=False) + "\n"
