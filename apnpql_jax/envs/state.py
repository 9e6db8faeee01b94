"""Pytrees of a batch of worlds, before and after an instant is observed."""

from __future__ import annotations

from flax import struct
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.types import Array, Observation, TimeStep


class EnvState(struct.PyTreeNode):
  """The complete state of the worlds at an observed instant."""

  physics: PhysicsState
  targets: Float[Array, "worlds 3 6"]  # joint targets of the primitives, rad
  elapsed: Int[Array, " worlds"]  # control periods since the reset
  timestep: TimeStep
  faults: Int[Array, " worlds"]  # resets because a value was not finite
  # [worlds, L, ...], for agents with an LSTM; short episodes repeat their first.
  recent: Observation | None = None

  @property
  def observation(self) -> Observation:
    """The agent's input: the present observation, or the last L, oldest first."""
    return self.timestep.observation if self.recent is None else self.recent


class Arrival(struct.PyTreeNode):
  """An instant that the worlds have reached but that is not observed yet."""

  physics: PhysicsState
  targets: Float[Array, "worlds 3 6"]  # joint targets of the instant before, rad
  elapsed: Int[Array, " worlds"]  # control periods since the reset
  fresh: Bool[Array, " worlds"]  # an episode begins here
  history: Float[Array, "worlds 21"]  # robot states of the instant before
  faults: Int[Array, " worlds"]  # as in ``EnvState``
  recent: Observation | None  # [worlds, L, ...], of the instant before

  @classmethod
  def after(
    cls,
    before: EnvState,
    physics: PhysicsState,
    targets: Float[Array, "worlds 3 6"],
    fresh: Bool[Array, " worlds"],
  ) -> Arrival:
    """Returns the instant after ``before``; ``targets`` count where it is ``fresh``."""
    return cls(
      physics=physics,
      targets=where_world(fresh, targets, before.targets),
      elapsed=jnp.where(fresh, 0, before.elapsed + 1),
      fresh=fresh,
      history=before.timestep.observation.robot,
      faults=before.faults,
      recent=before.recent,
    )


def where_world(condition: Bool[Array, " worlds"], yes: Array, no: Array) -> Array:
  """Selects whole worlds: ``jnp.where`` over the first axis of [worlds, ...]."""
  shape = condition.shape + (1,) * (yes.ndim - condition.ndim)
  return jnp.where(condition.reshape(shape), yes, no)
