"""Training progress on standard error: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import datetime
import sys
import time
from typing import Any, TextIO

from apnpql_jax.console import Unfailing

_SPEED_PERIOD_S = 600.0
"""Speeds are averaged over this time, which has to span several slow iterations."""

_OTHER_COLUMNS = len("  100%  >00:00:00 left")
"""Columns of the display besides the bar and the figures."""

_UNKNOWN = "-:--:--"
"""Time left before there is a speed."""


class TrainProgress:
  """Display of success rate, speeds and time left.

  Use as a context manager. Speeds count from the first update on, so that the first
  compilation does not lower them, and leave evaluations out. The time left is that of
  the steps, checkpoints included, plus the evaluations to come at their mean time
  without the first one, which also compiles. Before the first, it is a lower bound.
  """

  def __init__(
    self,
    total_steps: int,
    *,
    eval_every: int | None = None,
    stream: TextIO | None = None,
    period_s: float = 15.0,
    clock: Callable[[], float] = time.monotonic,
  ):
    """Builds the display without showing it.

    Without a terminal, a line is printed every ``period_s`` seconds. ``stream`` is
    standard error if None. There is an evaluation every ``eval_every`` steps and at the
    end, or none.
    """
    from rich import console, progress

    unfailing: Any = Unfailing(stream or sys.stderr)
    self._period, self._clock = period_s, clock
    self._total, self._eval_every = total_steps, eval_every
    self._evaluations: list[float] = []  # seconds
    self._evaluating = False
    shown = console.Console(file=unfailing)
    self._bar_width = 20 if shown.width >= 96 else 5 if shown.width >= 60 else 0
    bars = [progress.BarColumn(self._bar_width)] if self._bar_width else []
    self._bar = progress.Progress(
      *bars,
      progress.TaskProgressColumn(),
      progress.TextColumn("{task.fields[figures]}", markup=False),
      progress.TextColumn("{task.fields[left]} left", style="progress.remaining"),
      console=shown,
      speed_estimate_period=_SPEED_PERIOD_S,
      get_time=lambda: clock() - sum(self._evaluations),
      disable=not unfailing.isatty(),
    )
    self._bar.add_task("steps", total=total_steps, figures="starting", left=_UNKNOWN)
    self._bar.add_task("updates", total=None, visible=False)
    self._steps, self._updates = self._bar.tasks
    self._success: float | None = None
    self._printed_at = -float("inf")
    self._unprinted = False

  def __enter__(self) -> TrainProgress:
    self._bar.start()
    return self

  def __exit__(self, *exception: object) -> None:
    self._bar.stop()
    if self._unprinted:
      self._print_line()

  def update(
    self, step: int, *, updates: int, success_rate: float | None = None
  ) -> None:
    """Shows environment steps and updates done, including those before a resume.

    A ``success_rate`` (in [0, 1]) of None keeps the previous one.
    """
    if success_rate is not None:
      self._success = success_rate
    self._bar.update(self._updates.id, completed=updates)
    self._bar.update(self._steps.id, completed=step)
    self._show()
    if self._bar.disable:
      self._unprinted = True
      if self._clock() - self._printed_at >= self._period:
        self._print_line()

  @contextlib.contextmanager
  def evaluation(self) -> Generator[None, None, None]:
    """Measures an evaluation, which is the block."""
    began, self._evaluating = self._clock(), True
    self._show()
    try:
      yield
    finally:
      self._evaluating = False
      self._evaluations.append(self._clock() - began)
      self._show()

  def message(self, text: str) -> None:
    """Prints a line that stays, above the bar."""
    self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)

  def _show(self) -> None:
    """Updates what the bar shows next to the steps."""
    room = self._bar.console.width - self._bar_width - _OTHER_COLUMNS
    shown: list[str] = []
    for figure in (*self._figures(), f"{self._steps.completed:,} steps"):
      if len("  ".join([*shown, figure])) <= room:
        shown.append(figure)
    text = "  ".join(shown)
    self._bar.update(self._steps.id, figures=text, left=self._left())

  def _left(self) -> str:
    """Returns the time left as hours, minutes and seconds."""
    seconds = self._steps.time_remaining
    if seconds is None:
      return _UNKNOWN
    left = self._evaluations_left()
    if known := self._evaluations[1:] or self._evaluations:
      seconds += left * sum(known) / len(known)
    bound = ">" if left and not known else ""
    return f"{bound}{datetime.timedelta(seconds=round(seconds))}"

  def _evaluations_left(self) -> int:
    """Returns the number of evaluations to come, the present one included."""
    if self._eval_every is None:
      return 0
    step, every = int(self._steps.completed), self._eval_every
    at_end = step < self._total and self._total % every > 0
    return max(self._total // every - step // every, 0) + at_end + self._evaluating

  def _figures(self) -> list[str]:
    """Returns success and speeds, the most important first."""
    success = "--" if self._success is None else f"{100 * self._success:.0f} %"
    figures = [f"success {success}"]
    if steps_per_s := self._steps.speed:
      figures.append(f"{steps_per_s:,.0f} steps/s")
    if updates_per_s := self._updates.speed:
      figures.append(f"{updates_per_s:,.1f} updates/s")
    return figures

  def _print_line(self) -> None:
    steps = self._steps
    done = f"step {steps.completed:,} of {steps.total:,} ({steps.percentage:.0f} %)"
    self.message("  ".join([done, *self._figures(), f"{self._left()} left"]))
    self._printed_at, self._unprinted = self._clock(), False
