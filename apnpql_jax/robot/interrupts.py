"""Signals that a terminal or an operator sends to all processes at once."""

from __future__ import annotations

import signal

INTERRUPTS = (
  *(signal.SIGINT, signal.SIGTERM, signal.SIGHUP),
  *(signal.SIGQUIT, signal.SIGTSTP),  # Ctrl-\ and Ctrl-Z.
)


def leave_to_the_main_process() -> None:
  """Ignores ``INTERRUPTS``: the main process brakes first."""
  for number in INTERRUPTS:
    signal.signal(number, signal.SIG_IGN)
