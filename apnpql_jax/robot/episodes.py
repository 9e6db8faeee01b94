"""What a session is to do, and what becomes of its episodes."""

from __future__ import annotations

import dataclasses

SOLVED, TIME_LIMIT = "solved", "time limit"


@dataclasses.dataclass(frozen=True)
class Options:
  """How a session runs."""

  seed: int = 0
  """Random seed of the policy and of simulated reset states."""

  admittance: bool = True
  """Whether contacts move the virtual arm."""

  latency_s: float = 0.0
  """Delay of commands to a simulated arm, s."""

  log: str | None = None
  """Folder of the log to write."""

  replay: str | None = None
  """Log whose actions to repeat instead of the policy's."""


@dataclasses.dataclass(frozen=True)
class Home:
  """What came of a way home."""

  free: list[float] | None = None
  """What the free hand read there, f64[6] in N and N m, with the zero of the motion
  before; None if the robot did not get there."""

  put_back: str | None = None
  """Why a simulated robot did not get there and was put back where it began."""


@dataclasses.dataclass(frozen=True)
class Outcome:
  """What became of an episode."""

  solved: bool | None
  """Whether the task was solved; None if nobody can tell."""

  reason: str
  """solved, time limit, or why the arm stopped."""

  actions: int
  """Number of the policy's actions."""

  seconds: float
  """Duration."""

  events: list[tuple[float, str, str]]
  """Changes of the mode: time since the beginning in s, mode, reason."""

  missed_periods: int = 0
  """Periods without an action, because the policy was late."""

  overruns: int = 0
  """Cycles of the control process after twice their period or longer."""

  dataset_index: int | None = None
  """Index of the episode in the dataset of the log, if it is there."""

  before: Home = Home()
  """The way home before the episode, after which the sensor was zeroed."""

  after: Home | None = None
  """The way home after the episode; None if there was none."""

  @property
  def stopped(self) -> bool:
    """Whether a fault ended it."""
    return self.reason not in (SOLVED, TIME_LIMIT)
