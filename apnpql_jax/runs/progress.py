"""What one sees while a run trains: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import collections
from collections.abc import Callable
import sys
import time
from typing import Any, TextIO

_WINDOW = 20
"""Reports that the speeds are averaged over."""


class TrainProgress:
  """Shows success rate, speeds and time left, on standard error.

  Use as a context manager. Speeds start with the second report, so that the time of
  the first compilation does not count.
  """

  def __init__(
    self,
    total_steps: int,
    *,
    stream: TextIO | None = None,
    period_s: float = 15.0,
    clock: Callable[[], float] = time.monotonic,
  ):
    """Sets up; nothing is shown before the first report.

    Args:
      total_steps: environment steps at which the run is done.
      stream: where to write; standard error if None.
      period_s: seconds between two plain lines.
      clock: seconds; only differences count.
    """
    self._total, self._period, self._clock = total_steps, period_s, clock
    self._stream = sys.stderr if stream is None else stream
    self._reports: collections.deque[tuple[float, int, int]]
    self._reports = collections.deque(maxlen=_WINDOW)
    self._success: float | None = None
    self._printed_at = -float("inf")
    self._unprinted = False
    self._bar: Any = None
    self._task: Any = None

  def __enter__(self) -> TrainProgress:
    if self._stream.isatty():
      self._bar = _make_bar(self._stream)
      self._task = self._bar.add_task("train", total=self._total, figures="starting")
      self._bar.start()
    return self

  def __exit__(self, *exception: object) -> None:
    if self._bar is not None:
      self._bar.stop()
    elif self._unprinted:
      self._print_line()

  def update(
    self, step: int, *, updates: int, success_rate: float | None = None
  ) -> None:
    """Reports where the run is.

    Args:
      step: environment steps done, those before a resume included.
      updates: learner updates done.
      success_rate: newest success rate in [0, 1]; None keeps the one shown.
    """
    self._reports.append((self._clock(), step, updates))
    if success_rate is not None:
      self._success = success_rate
    if self._bar is not None:
      self._bar.update(self._task, completed=step, figures=self.figures())
      return
    self._unprinted = True
    if self._clock() - self._printed_at >= self._period:
      self._print_line()

  def message(self, text: str) -> None:
    """Writes a line that stays, above the bar."""
    if self._bar is not None:
      self._bar.console.print(text, markup=False, highlight=False)
    else:
      print(text, file=self._stream, flush=True)

  def figures(self) -> str:
    """Success rate, environment steps/s, updates/s and time left, as shown."""
    success = "--" if self._success is None else f"{100 * self._success:.0f} %"
    (t0, step0, updates0), (t1, step1, updates1) = self._reports[0], self._reports[-1]
    if t1 <= t0:
      return f"success {success}"
    speed, learning = (step1 - step0) / (t1 - t0), (updates1 - updates0) / (t1 - t0)
    figures = f"success {success}  {speed:,.0f} steps/s  {learning:,.1f} updates/s"
    if speed <= 0:
      return figures
    return f"{figures}  {_clock_text((self._total - step1) / speed)} left"

  def _print_line(self) -> None:
    step = self._reports[-1][1]
    share = 100 * step / max(self._total, 1)
    print(
      f"step {step:,} of {self._total:,} ({share:.0f} %)  {self.figures()}",
      file=self._stream,
      flush=True,
    )
    self._printed_at, self._unprinted = self._clock(), False


def _make_bar(stream: TextIO) -> Any:
  from rich.console import Console
  from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

  return Progress(
    BarColumn(bar_width=24),
    TaskProgressColumn(),
    TextColumn("{task.completed:,} steps"),
    TextColumn("{task.fields[figures]}", markup=False),
    console=Console(file=stream),
  )


def _clock_text(seconds: float) -> str:
  minutes, second = divmod(max(0, round(seconds)), 60)
  hours, minute = divmod(minutes, 60)
  return f"{hours}:{minute:02}:{second:02}"
