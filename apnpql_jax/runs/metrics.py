"""Metrics of a run: ``metrics.jsonl``, ``metrics.csv``, ``curve.png``, and extras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import csv
import io
import json
import math
from pathlib import Path
from statistics import NormalDist
import time
from typing import Any, Protocol

from apnpql_jax.errors import FileError
from apnpql_jax.runs.text import write_text

STEP = "step"
"""Environment steps, summed over worlds; the first column of every row."""

WALL = "time/wall_s"
"""Seconds of training, those before a resume included."""

SUCCESS = "eval/success_rate"
EPISODES = "eval/episodes"

MAX_BYTES = 32 << 20
"""Size at which ``metrics.jsonl`` is put aside as ``metrics.<n>.jsonl``."""

Row = dict[str, float | None]


def wilson_interval(
  successes: int, n: int, *, confidence: float = 0.95
) -> tuple[float, float]:
  """Score interval of Wilson (1927) for a share of successes, without continuity.

  Unlike the normal approximation it stays within [0, 1] and does not shrink to a
  point at 0 or ``n`` successes.

  Args:
    successes: between 0 and ``n``.
    n: independent episodes; 0 gives (0, 1).
    confidence: probability that the interval covers the true rate.

  Raises:
    ValueError: ``successes`` is not within [0, n].
  """
  if not 0 <= successes <= n:
    raise ValueError(f"{successes} successes of {n} episodes")
  if n == 0:
    return 0.0, 1.0
  z = NormalDist().inv_cdf(0.5 + confidence / 2)
  rate, scale = successes / n, 1 + z * z / n
  center = (rate + z * z / (2 * n)) / scale
  half = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n)) / scale
  # At the ends the bound is exact; the formula misses it by rounding.
  low = 0.0 if successes == 0 else center - half
  return low, 1.0 if successes == n else center + half


class Sink(Protocol):
  """Another place that metrics go to."""

  def write(self, step: int, row: Mapping[str, float]) -> None:
    """Takes the metrics of one step."""
    ...

  def close(self) -> None:
    """Writes out what is still held back."""
    ...


class MetricWriter:
  """Appends rows to ``metrics.jsonl`` and ``metrics.csv``, each whole on disk at once.

  The JSONL file is the record, the CSV file a view of it: a metric seen for the first
  time adds a column, and the CSV is written anew with the old rows empty there. Both
  are put aside when they have become large, the oldest as number 1.
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
    """Opens the files, keeping the rows there are.

    Args:
      run_dir: an existing run folder.
      resume_step: rows of later steps are dropped; the run will do them again.
      sinks: more places to write to; closed with this one.
      clock: seconds; only differences count.
      max_bytes: of ``metrics.jsonl``, above which a new one is begun.

    Raises:
      FileError: there are rows that cannot be read.
    """
    self._jsonl, self._csv = run_dir / "metrics.jsonl", run_dir / "metrics.csv"
    self._sinks, self._clock, self._max_bytes = tuple(sinks), clock, max_bytes
    rows = self._rows_until(resume_step)
    # Written anew, because a killed process may have left half a line.
    write_text(self._jsonl, "".join(_json_line(row) for row in rows))
    self._columns = list(dict.fromkeys([STEP, WALL, *(k for row in rows for k in row)]))
    self._write_csv(rows)
    self._start = clock() - ((rows[-1].get(WALL) or 0.0) if rows else 0.0)

  def write(self, step: int, metrics: Mapping[str, Any]) -> None:
    """Adds one row.

    Args:
      step: environment steps done.
      metrics: name -> number or array of one element. In JSONL, what is not finite
        becomes null.
    """
    numbers = {name: _number(value) for name, value in metrics.items()}
    row: Row = {STEP: step, WALL: round(self._clock() - self._start, 3), **numbers}
    with self._jsonl.open("a", encoding="utf-8") as file:
      file.write(_json_line(row))
    new = [name for name in row if name not in self._columns]
    if new:
      self._columns += new
      self._write_csv(read_rows(self._jsonl))
    else:
      with self._csv.open("a", encoding="utf-8", newline="") as file:
        csv.DictWriter(file, self._columns).writerow(row)
    if self._jsonl.stat().st_size > self._max_bytes:
      number = len(metric_files(self._jsonl.parent))
      for path in (self._jsonl, self._csv):
        path.rename(_numbered(path, number))
      self._write_csv([])
    for sink in self._sinks:
      sink.write(step, numbers)

  def close(self) -> None:
    """Closes the extra sinks; the files are always complete."""
    for sink in self._sinks:
      sink.close()

  def __enter__(self) -> MetricWriter:
    return self

  def __exit__(self, *exception: object) -> None:
    self.close()

  def _rows_until(self, step: int | None) -> list[Row]:
    """Rows up to ``step`` of the newest file with any; it becomes the present one."""
    rows = read_rows(self._jsonl)
    if step is None:
      return rows
    kept = [row for row in rows if (row[STEP] or 0) <= step]
    if not kept and (number := len(metric_files(self._jsonl.parent)) - 1) > 0:
      _numbered(self._csv, number).unlink(missing_ok=True)
      _numbered(self._jsonl, number).replace(self._jsonl)
      return self._rows_until(step)
    return kept

  def _write_csv(self, rows: Sequence[Row]) -> None:
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, self._columns)
    table.writeheader()
    table.writerows(rows)
    write_text(self._csv, text.getvalue())


def metric_files(run_dir: Path) -> list[Path]:
  """The JSONL files of a run: those put aside, oldest first, then the present one."""
  present, aside = run_dir / "metrics.jsonl", []
  while (path := _numbered(present, len(aside) + 1)).exists():
    aside.append(path)
  return [*aside, present]


def read_evaluations(run_dir: Path) -> list[Row]:
  """Rows of all evaluations of a run, oldest first."""
  files, told = metric_files(run_dir), json.dumps(SUCCESS)
  rows = (row for path in files for row in read_rows(path, having=told))
  return [row for row in rows if row.get(SUCCESS) is not None]


def _numbered(path: Path, number: int) -> Path:
  return path.with_suffix(f".{number}{path.suffix}")


def read_rows(path: Path, *, having: str = "") -> list[Row]:
  """Rows of a ``metrics.jsonl``, oldest first; none if there is no file.

  Args:
    path: the file.
    having: only lines with this text are looked at, one at a time: of a long run few
      rows are evaluations.

  Raises:
    FileError: a line is not a row, other than a last one that was cut off.
  """
  if not path.exists():
    return []
  rows = []
  with path.open(encoding="utf-8", errors="replace") as file:
    for number, line in enumerate(file, start=1):
      if not line.endswith("\n"):
        break
      if having not in line:
        continue
      try:
        row = json.loads(line)
        row[STEP] + 0
      except (ValueError, TypeError, KeyError):
        raise FileError(f"{path}, line {number}: not a row of metrics") from None
      rows.append(row)
  return rows


def plot_curve(rows: Sequence[Row], path: Path, *, title: str = "") -> bool:
  """Draws the success rate over environment steps and over wall-clock minutes.

  The band is the 95 % interval where rows also tell the number of episodes.

  Returns:
    False, drawing nothing, if no row has an evaluation.
  """
  rows = [row for row in rows if row.get(SUCCESS) is not None]
  if not rows:
    return False
  # Not pyplot: that would choose a display for the whole process.
  from matplotlib.backends.backend_agg import FigureCanvasAgg
  from matplotlib.figure import Figure

  rates = [row[SUCCESS] or 0.0 for row in rows]
  low, high = zip(*map(_interval, rows), strict=True)
  figure = Figure(figsize=(9.0, 3.6), layout="constrained")
  FigureCanvasAgg(figure)
  axes = figure.subplots(1, 2, sharey=True)
  steps = [row[STEP] or 0.0 for row in rows]
  minutes = [(row.get(WALL) or 0.0) / 60 for row in rows]
  for axis, x, label in zip(
    axes, (steps, minutes), ("environment steps", "wall-clock minutes"), strict=True
  ):
    axis.plot(x, [100 * rate for rate in rates], marker=".", color="C0")
    band = [[100 * bound for bound in bounds] for bounds in (low, high)]
    axis.fill_between(x, *band, alpha=0.25, color="C0", linewidth=0)
    axis.set(xlabel=label, ylim=(-2, 102))
    axis.grid(alpha=0.3)
  axes[0].set_ylabel("success of held-out episodes, %")
  figure.suptitle(title)
  part = path.with_name(path.name + ".part")
  figure.savefig(part, dpi=120, format="png")
  part.replace(path)
  return True


def _interval(row: Row) -> tuple[float, float]:
  rate, episodes = row[SUCCESS] or 0.0, row.get(EPISODES)
  if not episodes:
    return rate, rate
  return wilson_interval(round(rate * episodes), int(episodes))


def _number(value: Any) -> float:
  value = value.item() if hasattr(value, "item") else value
  return int(value) if isinstance(value, int) else float(value)


def _json_line(row: Row) -> str:
  plain = {
    name: value if value is None or math.isfinite(value) else None
    for name, value in row.items()
  }
  return json.dumps(plain, allow_nan=False) + "\n"
