"""Pytrees of a batch of worlds: the present instant, and one just come to."""

from __future__ import annotations

from flax import struct

from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.types import Array, Observation, TimeStep


class EnvState(struct.PyTreeNode):
  """Everything the worlds need to go on."""

  physics: PhysicsState  # [worlds, ...]
  targets: Array  # f32[worlds, 3, 6]: joint targets of the primitives, rad
  elapsed: Array  # i32[worlds]: control periods since the reset
  timestep: TimeStep  # [worlds, ...]: the present instant
  faults: Array  # i32[worlds]: times a world was reset for not being finite
  recent: Observation | None = None  # [worlds, L, ...]: for agents with an LSTM

  @property
  def seen(self) -> Observation:
    """What the agent acts on: the present observation, or the last L of the episode,
    oldest first, its first one repeated where it is shorter."""
    return self.timestep.observation if self.recent is None else self.recent


class Arrival(struct.PyTreeNode):
  """An instant the worlds have come to, before it is judged and observed."""

  physics: PhysicsState  # [worlds, ...]
  targets: Array  # f32[worlds, 3, 6]: joint targets as they were before, rad
  elapsed: Array  # i32[worlds]: control periods since the reset
  fresh: Array  # bool[worlds]: an episode begins here
  history: Array  # f32[worlds, 21]: robot states observed before
  faults: Array  # i32[worlds]: as in ``EnvState``
  recent: Observation | None  # [worlds, L, ...]: as it was before
