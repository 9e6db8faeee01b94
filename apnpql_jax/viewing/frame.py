"""Frames: everything that is shown of one instant of a watched world, in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Float, UInt8
import numpy as np

from apnpql_jax.agents.explanation import Explanation
from apnpql_jax.types import PRIMITIVES

COLORS = ("#e8590c", "#099268", "#7048e8")
"""Colors of the primitives object, goal and neutral, in plots and in the scene."""


@dataclasses.dataclass(frozen=True)
class ToolPath:
  """Path along which a primitive leads the tool, in the world frame."""

  positions: Float[np.ndarray, "points 3"]
  """Positions of the tool, from the present one on, m."""

  mat: Float[np.ndarray, "3 3"]
  """Rotation of the tool at the end of the path."""

  close: float
  """Probability of the command to close the gripper."""


@dataclasses.dataclass(frozen=True)
class Frame:
  """One instant of one world."""

  episode: int
  """Number of the episode, from 1."""

  time_s: float
  """Time since the beginning of the episode."""

  period_s: float
  """Time between two instants."""

  checkpoint: int | None
  """Step of the checkpoint that acts."""

  solved: bool
  """Whether the episode ended here with success."""

  last: bool
  """Whether the episode ended here; the action is not executed."""

  action: Float[np.ndarray, " 7"]
  """The action chosen here."""

  tool_paths: tuple[ToolPath, ...]
  """One per primitive."""

  stage: int
  """Primitive that the scripted expert would follow here."""

  explanation: Explanation | None
  """What led to the action, of a trained agent; arrays without a batch axis."""

  images: dict[str, UInt8[np.ndarray, "H W 3"]]
  """Images by camera: global and wrist, and wide if the player draws it."""

  poses: Any
  """Poses of all geoms, sites and cameras, ``sim.kinematics.Kinematics``."""

  @property
  def guided(self) -> bool:
    """Whether the actor has a prior with one component per primitive."""
    prior = self.explanation.prior if self.explanation else None
    return prior is not None and len(prior.shares) == len(PRIMITIVES)

  @property
  def shares(self) -> Float[np.ndarray, " 3"]:
    """Weight of each primitive: that of the prior, or all on the expert's stage."""
    if self.explanation and self.explanation.prior and self.guided:
      return np.asarray(self.explanation.prior.shares)
    return np.eye(len(PRIMITIVES))[self.stage]

  @property
  def headline(self) -> str:
    """The likeliest primitive, and whose it is."""
    likely = PRIMITIVES[int(np.argmax(self.shares))]
    return f"{'prior' if self.guided else 'expert'}: {likely}"
