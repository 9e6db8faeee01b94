"""Frames: all that can be seen of one instant of a watched world, in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxtyping import Float, UInt8
import numpy as np

from apnpql_jax.agents.explanation import Explanation

COLORS = ("#e8590c", "#099268", "#7048e8")
"""Colors of the primitives object, goal and neutral, in plots and in the scene."""


@dataclasses.dataclass(frozen=True)
class Hand:
  """Where a primitive leads the tool, in the world; lengths in m."""

  path: Float[np.ndarray, "points 3"]
  """Positions of the tool on the way, from the present one."""

  mat: Float[np.ndarray, "3 3"]
  """Rotation of the tool at the end."""

  close: float
  """Probability with which the gripper shall close."""


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

  hands: tuple[Hand, ...]
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
  def shares(self) -> Float[np.ndarray, " 3"]:
    """Weight of each primitive: that of the prior, or all on the expert's stage."""
    prior = self.explanation.prior if self.explanation else None
    if prior is not None and len(prior.shares) == len(COLORS):
      return np.asarray(prior.shares)
    return np.eye(len(COLORS))[self.stage]
