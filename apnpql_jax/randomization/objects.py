"""Sizes, shapes and masses of the objects of a world, and what follows from them."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.randomization.draw import Draw, World, free_bodies
from apnpql_jax.types import Array


def scale(draw: Draw, world: World, qpos: Array) -> Array:
  """Scales objects about their frames, along z by a factor of its own.

  Returns:
    f32[nq]: the objects stand where they stood.
  """
  if not (draw.config.size or draw.config.shape):
    return qpos
  model, objects = world.model, np.flatnonzero(free_bodies(world.model))
  width = draw.share("size", (model.nbody,))
  height = width * draw.share("shape", (model.nbody,))
  factors = jnp.stack([width, width, height], axis=-1)[objects]
  of_body = jnp.ones((model.nbody, 3)).at[objects].set(factors)
  of_geom = of_body[model.geom_bodyid]
  axes = of_geom[:, :1] + (of_geom[:, 2:] - of_geom[:, :1]) * _upright(model.geom_quat)
  world["geom_size"] = world["geom_size"] * _of_sizes(model, axes)
  world["geom_pos"] = world["geom_pos"] * of_geom
  world["geom_aabb"] = world["geom_aabb"] * jnp.tile(axes, 2)
  world["geom_rbound"] = world["geom_rbound"] * of_geom.max(axis=-1)
  world["body_ipos"] = world["body_ipos"] * of_body
  # An inertia is the sum of the second moments along the other two axes.
  inertia = world["body_inertia"]
  moments = 0.5 * inertia[objects].sum(-1, keepdims=True) - inertia[objects]
  moments = moments * factors**2
  changed = moments.sum(-1, keepdims=True) - moments
  world["body_inertia"] = inertia.at[objects].set(changed)
  address = model.jnt_qposadr[model.body_jntadr[objects]]
  standing = _upright(qpos[address[:, None] + np.arange(3, 7)])[:, 2]
  tall = factors[:, 0] + (factors[:, 2] - factors[:, 0]) * standing
  return qpos.at[address + 2].multiply(tall)


def _upright(quat: Array | np.ndarray) -> Array:
  """f32[*b, 3]: how far along z, from 0 to 1, the axes of frames [*b, 4] lie."""
  w, x, y, z = jnp.moveaxis(jnp.asarray(quat, jnp.float32), -1, 0)
  along = [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)]
  return jnp.abs(jnp.stack(along, axis=-1))


def _of_sizes(model: mujoco.MjModel, axes: Array) -> Array:
  """f32[ngeom, 3]: factors of MuJoCo's sizes, from those along the geoms' own axes."""
  kinds = mujoco.mjtGeom
  radius = axes[:, :2].mean(axis=-1)
  round_ = jnp.stack([radius, axes[:, 2], axes[:, 2]], axis=-1)
  is_round = np.isin(
    model.geom_type, [kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER]
  )
  return jnp.where(is_round[:, None], round_, axes)


def weigh(draw: Draw, world: World) -> None:
  """Makes objects heavier or lighter."""
  if not draw.config.mass:
    return
  objects = free_bodies(world.model)
  factor = jnp.where(objects, draw.share("mass", (world.model.nbody,)), 1.0)
  gained = (factor - 1.0) * world["body_mass"]
  world["body_mass"] = world["body_mass"] * factor
  world["body_inertia"] = world["body_inertia"] * factor[:, None]
  whole = world["body_subtreemass"] + gained
  world["body_subtreemass"] = whole.at[0].add(gained.sum())


def derive(world: World) -> None:
  """What MuJoCo derives from mass, inertia and center of the bodies that float freely.

  A free joint moves along three axes, then turns about three. Axes of inertia are those
  of the body.
  """
  model = world.model
  objects = np.flatnonzero(free_bodies(model))
  dof = model.body_dofadr[objects][:, None] + np.arange(6)
  mass = world["body_mass"][objects, None]
  inertia, square = world["body_inertia"][objects], world["body_ipos"][objects] ** 2
  lever = square.sum(axis=-1, keepdims=True) - square  # Squared, about each axis.
  along = jnp.repeat(mass, 3, axis=-1)
  weight = jnp.concatenate([along, inertia + mass * lever], axis=-1)
  moves = 1.0 / mass + (lever / inertia).mean(axis=-1, keepdims=True)
  turns = (1.0 / inertia).mean(axis=-1, keepdims=True)
  inverse = jnp.repeat(jnp.concatenate([moves, turns], axis=-1), 3, axis=-1)
  world["dof_M0"] = world["dof_M0"].at[dof].set(weight)
  world["dof_invweight0"] = world["dof_invweight0"].at[dof].set(inverse)
  about = jnp.concatenate([1.0 / mass, turns], axis=-1)
  world["body_invweight0"] = world["body_invweight0"].at[objects].set(about)
