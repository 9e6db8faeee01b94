"""Options of a session, and the outcomes of its episodes."""

from __future__ import annotations

import dataclasses

SOLVED, TIME_LIMIT = "solved", "time limit"


@dataclasses.dataclass(frozen=True)
class Options:
  """Options of a session."""

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
class Homing:
  """Outcome of a motion to the neutral pose."""

  unloaded_wrench: list[float] | None = None
  """What the hand read there, where nothing should touch it, f64[6] in N and N m, with
  the zero of the motion before; None if the robot did not get there."""

  reset_reason: str | None = None
  """Why a simulated robot did not get there and was reset."""


@dataclasses.dataclass(frozen=True)
class Outcome:
  """Outcome of an episode."""

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

  homing_before: Homing = Homing()
  """Outcome of the homing before the episode, after which the sensor was zeroed."""

  homing_after: Homing | None = None
  """Outcome of the homing after the episode; None if there was none."""

  @property
  def stopped(self) -> bool:
    """Whether a fault ended it."""
    return self.reason not in (SOLVED, TIME_LIMIT)
