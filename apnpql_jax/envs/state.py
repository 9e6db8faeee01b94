"""Pytrees of a batch of worlds, before and after an instant is observed."""

from __future__ import annotations

import functools

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.types import Array, Observation, TimeStep


class EnvState(struct.PyTreeNode):
  """The complete state of the worlds at an observed instant."""

  physics: PhysicsState
  """State of the simulation."""

  targets: Float[Array, "worlds 3 6"]
  """Joint targets of the primitives, rad."""

  elapsed: Int[Array, " worlds"]
  """Control periods since the reset."""

  timestep: TimeStep
  """The instant: observation, reward, end of the episode, labels."""

  faults: Int[Array, " worlds"]
  """Number of resets because of a non-finite value."""

  recent: Observation | None = None
  """Last L observations [worlds, L, ...], for agents with an LSTM. An episode of fewer
  instants repeats its first."""

  @property
  def observation(self) -> Observation:
    """The agent's input: the present observation, or the last L, oldest first."""
    return self.timestep.observation if self.recent is None else self.recent


class Arrival(struct.PyTreeNode):
  """An instant that the worlds have reached but that is not observed yet."""

  physics: PhysicsState
  """State of the simulation."""

  targets: Float[Array, "worlds 3 6"]
  """Joint targets of the primitives at the instant before, rad."""

  elapsed: Int[Array, " worlds"]
  """Control periods since the reset."""

  fresh: Bool[Array, " worlds"]
  """Whether an episode begins here."""

  history: Float[Array, "worlds 21"]
  """Robot states at the instant before, as in ``Observation.robot``."""

  faults: Int[Array, " worlds"]
  """Number of resets because of a non-finite value."""

  recent: Observation | None
  """Last L observations [worlds, L, ...] at the instant before."""

  @classmethod
  def after(
    cls,
    before: EnvState,
    physics: PhysicsState,
    targets: Float[Array, "worlds 3 6"],
    fresh: Bool[Array, " worlds"],
  ) -> Arrival:
    """Returns the instant after ``before``; ``targets`` apply where it is ``fresh``."""
    return cls(
      physics=physics,
      targets=where_world(fresh, targets, before.targets),
      elapsed=jnp.where(fresh, 0, before.elapsed + 1),
      fresh=fresh,
      history=before.timestep.observation.robot,
      faults=before.faults,
      recent=before.recent,
    )


def truncate_faults(before: EnvState, after: EnvState) -> EnvState:
  """Truncates the episodes of worlds that a step from ``before`` has found broken.

  Such a world is already in another episode. Its observation becomes the last one of
  the episode that broke, so that no transition leads from one episode to another.
  """
  broken = after.faults > before.faults
  observation = jax.tree.map(
    functools.partial(where_world, broken),
    before.timestep.observation,
    after.timestep.observation,
  )
  truncated = after.timestep.truncated | broken
  timestep = after.timestep.replace(observation=observation, truncated=truncated)
  return after.replace(timestep=timestep)


def where_world(condition: Bool[Array, " worlds"], yes: Array, no: Array) -> Array:
  """Selects whole worlds: ``jnp.where`` over the first axis of [worlds, ...]."""
  shape = condition.shape + (1,) * (yes.ndim - condition.ndim)
  return jnp.where(condition.reshape(shape), yes, no)
