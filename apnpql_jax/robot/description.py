"""The description of a robot, from which each process opens its devices."""

from __future__ import annotations

import dataclasses
from typing import Any

from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock

ROBOTS = ("ur5e", "simulated", "double")


@dataclasses.dataclass(frozen=True)
class Robot:
  """Description of a robot, which is sent to each process."""

  kind: str
  """One of ``ROBOTS``."""

  contract: dict[str, Any]
  """The contract of the policy."""

  cell: Cell
  """The cell, with addresses and limits."""

  clock: Clock = Clock()
  """The clock of the session."""

  plant: str = ""
  """Name of the shared memory of a simulated plant."""

  @property
  def can_judge(self) -> bool:
    """Whether it shows that the task is solved; no sensor of a real arm does."""
    return self.kind == "simulated"
