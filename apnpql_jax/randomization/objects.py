"""Sizes, shapes and masses of a world's objects, and constants derived from them."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.randomization.draw import Draw, World, free_bodies
from apnpql_jax.types import Array


def scale(draw: Draw, world: World, qpos: Array) -> Array:
  """Scales objects, separately along z; returns qpos with them back on the table."""
  if not (draw.config.size or draw.config.shape):
    return qpos
  model, objects = world.model, np.flatnonzero(free_bodies(world.model))
  width = draw.factor("size", (model.nbody,))
  height = width * draw.factor("shape", (model.nbody,))
  factors = jnp.stack([width, width, height], axis=-1)[objects]

  # Scale geoms along their own axes, which need not be those of the body.
  body_factors = jnp.ones((model.nbody, 3)).at[objects].set(factors)
  geom_factors = body_factors[model.geom_bodyid]
  across, along = geom_factors[:, :1], geom_factors[:, 2:]
  axes = across + (along - across) * _uprightness(model.geom_quat)
  world["geom_size"] *= _size_factors(model, axes)
  world["geom_pos"] *= geom_factors
  world["geom_aabb"] *= jnp.tile(axes, 2)
  world["geom_rbound"] *= geom_factors.max(axis=-1)
  world["body_ipos"] *= body_factors

  # An inertia is the sum of the second moments along the other two axes.
  inertia = world["body_inertia"]
  moments = 0.5 * inertia[objects].sum(-1, keepdims=True) - inertia[objects]
  moments = moments * factors**2
  scaled = moments.sum(-1, keepdims=True) - moments
  world["body_inertia"] = inertia.at[objects].set(scaled)

  # Objects on the table keep standing on it.
  address = model.jnt_qposadr[model.body_jntadr[objects]]
  upright = _uprightness(qpos[address[:, None] + np.arange(3, 7)])[:, 2]
  vertical = factors[:, 0] + (factors[:, 2] - factors[:, 0]) * upright
  return qpos.at[address + 2].multiply(vertical)


def _uprightness(quat: Array | np.ndarray) -> Array:
  """Returns the absolute z components f32[*b, 3] of the axes of frames [*b, 4]."""
  w, x, y, z = jnp.moveaxis(jnp.asarray(quat, jnp.float32), -1, 0)
  along = [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]
  return jnp.abs(jnp.stack(along, axis=-1))


def _size_factors(model: mujoco.MjModel, axes: Array) -> Array:
  """Converts factors along the geoms' own axes to those of MuJoCo's sizes."""
  kinds = mujoco.mjtGeom
  radius = axes[:, :2].mean(axis=-1)
  round_ = jnp.stack([radius, axes[:, 2], axes[:, 2]], axis=-1)
  rounds = kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER
  return jnp.where(np.isin(model.geom_type, rounds)[:, None], round_, axes)


def weigh(draw: Draw, world: World) -> None:
  """Makes objects heavier or lighter."""
  if not draw.config.mass:
    return
  objects = free_bodies(world.model)
  factor = jnp.where(objects, draw.factor("mass", (world.model.nbody,)), 1.0)
  gained = (factor - 1.0) * world["body_mass"]
  world["body_mass"] *= factor
  world["body_inertia"] *= factor[:, None]
  whole = world["body_subtreemass"] + gained
  world["body_subtreemass"] = whole.at[0].add(gained.sum())


def derive(world: World) -> None:
  """Recomputes MuJoCo's constants that depend on objects' mass, inertia and center."""
  # A free joint moves along three axes, then turns about those of inertia.
  model = world.model
  objects = np.flatnonzero(free_bodies(model))
  dof = model.body_dofadr[objects][:, None] + np.arange(6)
  mass = world["body_mass"][objects, None]
  inertia, square = world["body_inertia"][objects], world["body_ipos"][objects] ** 2
  lever = square.sum(axis=-1, keepdims=True) - square  # Squared, about each axis.
  weight = jnp.concatenate([jnp.repeat(mass, 3, -1), inertia + mass * lever], -1)
  moves = 1.0 / mass + (lever / inertia).mean(axis=-1, keepdims=True)
  turns = (1.0 / inertia).mean(axis=-1, keepdims=True)
  inverse = jnp.repeat(jnp.concatenate([moves, turns], axis=-1), 3, axis=-1)
  world["dof_M0"] = world["dof_M0"].at[dof].set(weight)
  world["dof_invweight0"] = world["dof_invweight0"].at[dof].set(inverse)
  about = jnp.concatenate([1.0 / mass, turns], axis=-1)
  world["body_invweight0"] = world["body_invweight0"].at[objects].set(about)
