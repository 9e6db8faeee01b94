"""The clock of a session: that of the machine, or a slower one for simulated robots."""

from __future__ import annotations

import dataclasses
import time


@dataclasses.dataclass(frozen=True)
class Clock:
  """Time in s that all processes of a machine share."""

  slowdown: float = 1.0
  """Seconds of the machine per second of the session; 1 for a real robot."""

  def now(self) -> float:
    """Returns the time of the session."""
    return time.monotonic() / self.slowdown

  def sleep(self, seconds: float) -> None:
    """Waits; not at all for a negative time."""
    time.sleep(max(0.0, seconds * self.slowdown))
