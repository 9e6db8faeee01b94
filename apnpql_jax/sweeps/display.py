"""Progress of a sweep on standard error: a table on a terminal, lines elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
import os
import sys
import time
from typing import Any, TextIO

from apnpql_jax.console import Unfailing
from apnpql_jax.reports.tables import Rows
from apnpql_jax.sweeps.following import Follower
from apnpql_jax.sweeps.manifest import (
  DONE,
  FAILED,
  RUNNING,
  STOPPED,
  WAITING,
  Entry,
  Manifest,
)

_ORDER = (RUNNING, FAILED, STOPPED, WAITING, DONE)
"""States from the most to the least interesting."""

_WIDE = 60  # columns of a terminal with room for all columns of the table

_STYLE = {RUNNING: "cyan", FAILED: "red", STOPPED: "yellow", DONE: "green"}


class SweepDisplay:
  """Display of all runs; use as a context manager."""

  def __init__(
    self,
    manifest: Manifest,
    *,
    stream: TextIO | None = None,
    period_s: float = 60.0,
    clock: Callable[[], float] = time.monotonic,
  ):
    """Builds the display without showing it.

    Without a terminal, a line is printed for each run that starts or ends, and one
    every ``period_s`` seconds. ``stream`` is standard error if None.
    """
    from rich.console import Console
    from rich.live import Live

    unfailing: Any = Unfailing(stream or sys.stderr)
    self._manifest, self._period, self._clock = manifest, period_s, clock
    self._console = Console(file=unfailing)
    self._live = Live(console=self._console, auto_refresh=False, transient=True)
    self._terminal = unfailing.isatty()
    self._followers = {x.name: Follower(manifest.run_dir(x)) for x in manifest.runs}
    self._shown_at = clock()

  def __enter__(self) -> SweepDisplay:
    if self._terminal:
      self._live.start()
    return self

  def __exit__(self, *exception: object) -> None:
    if self._terminal:
      self._live.stop()

  def report(self, entry: Entry) -> None:
    """Prints a line about a run that has started or ended."""
    follower = self._followers[entry.name]
    follower.update()
    text = f"{entry.state} {entry.name}"
    if entry.state == DONE and follower.success is not None:
      text += f": {100 * follower.success:.0f} % solved"
    if entry.state in (FAILED, STOPPED):
      text += f": {entry.line}"
    self._print(text)

  def show(self) -> None:
    """Shows the present state; without a terminal, only every ``period_s`` seconds."""
    now = self._clock()
    if now - self._shown_at < (1.0 if self._terminal else self._period):
      return
    self._shown_at = now
    for entry in self._manifest.runs:
      if entry.state == RUNNING:
        self._followers[entry.name].update()
    if self._terminal:
      self._live.update(self._table(), refresh=True)
    else:
      running = [x for x in self._manifest.runs if x.state == RUNNING]
      shares = (
        f"{x.name} {100 * self._followers[x.name].share:.0f} %" for x in running
      )
      self._print("; ".join([self._counts(), *shares]))

  def table(self, rows: Rows) -> None:
    """Prints a table that stays; the first row is its head."""
    from rich import box
    from rich.table import Table

    head, *body = rows
    table = Table(*head, box=box.SIMPLE_HEAD)
    for row in body:
      table.add_row(*row)
    if self._terminal:
      self._live.update("", refresh=True)
    self._console.print(table, highlight=False)

  def _print(self, text: str) -> None:
    self._console.print(text, markup=False, highlight=False, soft_wrap=True)

  def _counts(self) -> str:
    counts = Counter(entry.state for entry in self._manifest.runs)
    return ", ".join(f"{counts[state]} {state}" for state in _ORDER if counts[state])

  def _table(self) -> Any:
    """Returns as many rows as the terminal has room for."""
    from rich import box
    from rich.table import Table

    table = Table(
      box=box.SIMPLE_HEAD,
      pad_edge=False,
      caption=self._counts(),
      caption_justify="left",
    )
    table.add_column("run", overflow="ellipsis", no_wrap=True)
    table.add_column("state", no_wrap=True, min_width=7)
    columns = ["steps", "solved", "min", "left"]
    columns = columns if self._console.width >= _WIDE else columns[:2]
    for name in columns:
      table.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    # What all names begin with, such as the preset, is left out.
    shared = os.path.commonprefix([entry.name for entry in self._manifest.runs])
    cut = shared.rfind("-") + 1 if len(self._manifest.runs) > 1 else 0
    room = max(3, self._console.height - 7)
    for entry in sorted(self._manifest.runs, key=lambda x: _ORDER.index(x.state))[
      :room
    ]:
      follower = self._followers[entry.name]
      begun = follower.step > 0
      solved, left = follower.success, follower.left_s
      cells = [
        f"{100 * follower.share:.0f} %" if begun else "",
        "" if solved is None else f"{100 * solved:.0f} %",
        f"{follower.seconds / 60:.1f}" if begun else "",
        f"{left / 60:.1f}" if left and entry.state == RUNNING else "",
      ][: len(columns)]
      style = _STYLE.get(entry.state, "dim")
      table.add_row(entry.name[cut:], entry.state, *cells, style=style)
    return table
