"""A world that is being drawn: its random numbers, and its fields."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.scene import free_joints
from apnpql_jax.types import Array


@dataclasses.dataclass(frozen=True)
class Draw:
  """Random numbers of one world, one stream for each setting.

  A setting of 0 hence changes nothing in what the others draw.
  """

  key: Array
  config: RandomizationConfig

  def uniform(self, name: str, shape: tuple[int, ...] = ()) -> Array:
    """f32[shape] between minus and plus the range of a setting."""
    spread = getattr(self.config, name)
    return jax.random.uniform(self.stream(name), shape, jnp.float32, -spread, spread)

  def share(self, name: str, shape: tuple[int, ...] = ()) -> Array:
    """f32[shape] factors around one."""
    return 1.0 + self.uniform(name, shape)

  def stream(self, name: str) -> Array:
    """The key of a setting."""
    names = [field.name for field in dataclasses.fields(self.config)]
    return jax.random.fold_in(self.key, names.index(name))


class World:
  """One world that is being drawn: what its fields are by now."""

  def __init__(self, model: mujoco.MjModel, fields: dict[str, Array]):
    self.model = model
    self.fields = dict(fields)

  def __getitem__(self, name: str) -> Array:
    """A model field or the color of the background, f32[...]."""
    value = self.fields.get(name)
    if value is None:
      plain = Lighting() if name == "background" else self.model
      value = jnp.asarray(getattr(plain, name), jnp.float32)
    return value

  def __setitem__(self, name: str, value: Array) -> None:
    self.fields[name] = value


def free_bodies(model: mujoco.MjModel) -> np.ndarray:
  """bool[nbody]: the bodies that float freely."""
  return np.isin(np.arange(model.nbody), model.jnt_bodyid[free_joints(model)])
