"""The random numbers and the fields of a world that is being drawn."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import mujoco
import numpy as np

from apnpql_jax.colors import geom_rgba
from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.scene import free_joints
from apnpql_jax.types import Array


@dataclasses.dataclass(frozen=True)
class Draw:
  """Random numbers of one world, from a separate stream for each setting."""

  key: PRNGKeyArray
  config: RandomizationConfig

  def uniform(self, name: str, shape: tuple[int, ...] = ()) -> Array:
    """Draws f32[shape] between minus and plus the range of a setting."""
    spread = getattr(self.config, name)
    return jax.random.uniform(self.stream(name), shape, jnp.float32, -spread, spread)

  def factor(self, name: str, shape: tuple[int, ...] = ()) -> Array:
    """Draws factors f32[shape] around one, by the range of a setting."""
    return 1.0 + self.uniform(name, shape)

  def stream(self, name: str) -> Array:
    """Returns the key of a setting."""
    names = [field.name for field in dataclasses.fields(self.config)]
    return jax.random.fold_in(self.key, names.index(name))


class World(dict[str, Array]):
  """The fields of a world that is being drawn; others read as those of the model."""

  def __init__(self, model: mujoco.MjModel, fields: dict[str, Array]):
    super().__init__(fields)
    self.model = model

  def __missing__(self, name: str) -> Array:
    if name == "geom_rgba":
      return jnp.asarray(geom_rgba(self.model))
    source = Lighting() if name == "background" else self.model
    return jnp.asarray(getattr(source, name), jnp.float32)


def free_bodies(model: mujoco.MjModel) -> np.ndarray:
  """Returns a mask bool[nbody] of the bodies with a free joint."""
  return np.isin(np.arange(model.nbody), model.jnt_bodyid[free_joints(model)])
