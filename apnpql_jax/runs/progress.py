"""Training progress on standard error: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Callable
import sys
import time
from typing import Any, TextIO

from apnpql_jax.console import Unfailing

_SPEED_PERIOD_S = 600.0
"""Speeds are averaged over this time, which has to span several slow iterations."""


class TrainProgress:
  """Display of success rate, speeds and time left.

  Use as a context manager. Speeds count from the first update on, so that the first
  compilation does not lower them.
  """

  def __init__(
    self,
    total_steps: int,
    *,
    stream: TextIO | None = None,
    period_s: float = 15.0,
    clock: Callable[[], float] = time.monotonic,
  ):
    """Builds the display without showing it.

    Without a terminal, a line is printed every ``period_s`` seconds. ``stream`` is
    standard error if None.
    """
    from rich import console, progress

    unfailing: Any = Unfailing(stream or sys.stderr)
    self._period, self._clock = period_s, clock
    text = "{task.completed:,} steps  {task.fields[figures]}"
    self._time_left = progress.TimeRemainingColumn()
    self._bar = progress.Progress(
      progress.BarColumn(bar_width=24),
      progress.TaskProgressColumn(),
      progress.TextColumn(text, markup=False),
      self._time_left,
      console=console.Console(file=unfailing),
      speed_estimate_period=_SPEED_PERIOD_S,
      get_time=clock,
      disable=not unfailing.isatty(),
    )
    self._bar.add_task("steps", total=total_steps, figures="starting")
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
    self._bar.update(self._steps.id, figures=self._figures())
    if self._bar.disable:
      self._unprinted = True
      if self._clock() - self._printed_at >= self._period:
        self._print_line()

  def message(self, text: str) -> None:
    """Prints a line that stays, above the bar."""
    self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)

  def _figures(self) -> str:
    success = "--" if self._success is None else f"{100 * self._success:.0f} %"
    figures = [f"success {success}"]
    if steps_per_s := self._steps.speed:
      figures.append(f"{steps_per_s:,.0f} steps/s")
    if updates_per_s := self._updates.speed:
      figures.append(f"{updates_per_s:,.1f} updates/s")
    return "  ".join(figures)

  def _print_line(self) -> None:
    steps = self._steps
    self.message(
      f"step {steps.completed:,} of {steps.total:,} ({steps.percentage:.0f} %)  "
      f"{steps.fields['figures']}  {self._time_left.render(steps)} left"
    )
    self._printed_at, self._unprinted = self._clock(), False
