"""Sizes, shapes and masses of a world's objects, and constants derived from them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.errors import ConfigError
from apnpql_jax.randomization.draw import Draw, World, free_bodies
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import geometry
from apnpql_jax.types import Array


def check(config: RandomizationConfig, scene: Scene) -> None:
  """Checks that the objects of a scene can change as ``config`` says.

  Raises:
    ConfigError: An object has a mesh, or parts of its own.
  """
  model, free = scene.model, free_bodies(scene.model)
  meshes = free[model.geom_bodyid] & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
  parts = free[model.body_parentid]
  if (config.size or config.shape) and meshes.any():
    body = _title(model, model.geom_bodyid[meshes.argmax()])
    raise ConfigError(
      f"{scene.name}.xml: {body} has a mesh, which cannot change its size; set "
      "env.randomization.size and .shape to 0, or build the body of primitives"
    )
  if (config.size or config.shape or config.mass) and parts.any():
    part = parts.argmax()
    body = _title(model, model.body_parentid[part])
    raise ConfigError(
      f"{scene.name}.xml: {body} carries {_title(model, part)}, so it can change "
      "neither size nor mass; set env.randomization.size, .shape and .mass to 0, or "
      "make it one body"
    )


def scale(draw: Draw, world: World, qpos: Array) -> Array:
  """Scales objects, separately along z; returns qpos in which they still stand."""
  if not (draw.config.size or draw.config.shape):
    return qpos
  model, objects = world.model, np.flatnonzero(free_bodies(world.model))
  heights = _heights(world, qpos)
  width = draw.factor("size", (model.nbody,))
  height = width * draw.factor("shape", (model.nbody,))
  factors = jnp.stack([width, width, height], axis=-1)[objects]

  # Scale geoms along their own axes, which need not be those of the body.
  body_factors = jnp.ones((model.nbody, 3)).at[objects].set(factors)
  geom_factors = body_factors[model.geom_bodyid]
  across, along = geom_factors[:, :1], geom_factors[:, 2:]
  axes = across + (along - across) * jnp.abs(_up(world["geom_quat"]))
  world["geom_size"] *= _size_factors(model, axes)
  world["geom_pos"] *= geom_factors
  world["geom_aabb"] *= jnp.tile(axes, 2)
  world["geom_rbound"] *= geom_factors.max(axis=-1)
  world["body_ipos"] *= body_factors

  # An inertia is the sum of the second moments along the other two axes. The axes are
  # kept, which is exact if one of them is the body's z axis.
  up = _up(world["body_iquat"][objects])
  share = up[:, :, None] * up[:, None]
  across, along = factors[:, :1, None], factors[:, 2:, None]
  stretch = across * (jnp.eye(3) - share) + along * share
  inertia = world["body_inertia"]
  moments = 0.5 * inertia[objects].sum(-1, keepdims=True) - inertia[objects]
  moments = (stretch**2 * moments[:, None]).sum(-1)
  scaled = moments.sum(-1, keepdims=True) - moments
  world["body_inertia"] = inertia.at[objects].set(scaled)

  # Objects keep standing where they stand.
  address = model.jnt_qposadr[model.body_jntadr[objects]]
  return qpos.at[address + 2].add(_heights(world, qpos) - heights)


def _title(model: mujoco.MjModel, body: int) -> str:
  return f"body '{model.body(body).name or body}'"


def _heights(world: World, qpos: Array) -> Array:
  """Returns f32[objects]: how far objects reach below their origins, m."""
  model, objects = world.model, np.flatnonzero(free_bodies(world.model))
  listed = np.isin(np.arange(model.ngeom), [model.pair_geom1, model.pair_geom2])
  solid = listed | (model.geom_contype > 0) | (model.geom_conaffinity > 0)
  geoms = np.flatnonzero(solid & np.isin(model.geom_bodyid, objects))
  body = model.geom_bodyid[geoms]
  address = model.jnt_qposadr[model.body_jntadr[body]]
  up = _up(qpos[address[:, None] + np.arange(3, 7)])
  own = (up[:, :, None] * _rotation(world["geom_quat"][geoms])).sum(-2)
  reach = _reach(model.geom_type[geoms], world["geom_size"][geoms], own)
  depth = reach - (up * world["geom_pos"][geoms]).sum(-1)
  lowest = jax.ops.segment_max(depth, np.searchsorted(objects, body), len(objects))
  return jnp.where(jnp.isfinite(lowest), lowest, 0.0)  # Nothing of some may collide.


def _reach(kind: np.ndarray, size: Array, way: Array) -> Array:
  """Returns how far geoms reach from their centers along unit vectors f32[n, 3], m."""
  kinds = mujoco.mjtGeom
  radius = size[:, 0]
  length = size[:, 1] * jnp.abs(way[:, 2])
  reaches = {
    kinds.mjGEOM_SPHERE: radius,
    kinds.mjGEOM_CAPSULE: radius + length,
    kinds.mjGEOM_CYLINDER: radius * jnp.hypot(way[:, 0], way[:, 1]) + length,
    kinds.mjGEOM_ELLIPSOID: jnp.linalg.norm(size * way, axis=-1),
  }
  box = (size * jnp.abs(way)).sum(-1)
  return jnp.select([kind == key for key in reaches], list(reaches.values()), box)


def _rotation(quat: Array) -> Array:
  """Returns the rotations f32[*b, 3, 3] of quaternions f32[*b, 4]."""
  return jnp.stack([geometry.axis(quat, index) for index in range(3)], axis=-1)


def _up(quat: Array) -> Array:
  """Returns the z axis f32[*b, 3] of the world in frames of quaternions f32[*b, 4]."""
  return _rotation(quat)[..., 2, :]


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
  # A free joint moves along three axes, then turns about those of the body.
  model = world.model
  objects = np.flatnonzero(free_bodies(model))
  dof = model.body_dofadr[objects][:, None] + np.arange(6)
  mass, inertia = world["body_mass"][objects, None], world["body_inertia"][objects]
  center, axes = world["body_ipos"][objects], _rotation(world["body_iquat"][objects])
  about = (axes**2 * inertia[:, None]).sum(-1) + mass * _levers(center)
  weight = jnp.concatenate([jnp.repeat(mass, 3, -1), about], -1)
  levers = _levers((axes * center[..., None]).sum(-2))
  moves = 1.0 / mass + (levers / inertia).mean(axis=-1, keepdims=True)
  turns = (1.0 / inertia).mean(axis=-1, keepdims=True)
  inverse = jnp.repeat(jnp.concatenate([moves, turns], axis=-1), 3, axis=-1)
  world["dof_M0"] = world["dof_M0"].at[dof].set(weight)
  world["dof_invweight0"] = world["dof_invweight0"].at[dof].set(inverse)
  about = jnp.concatenate([1.0 / mass, turns], axis=-1)
  world["body_invweight0"] = world["body_invweight0"].at[objects].set(about)


def _levers(center: Array) -> Array:
  """Returns squared distances f32[*b, 3] of points f32[*b, 3] from the three axes."""
  square = center**2
  return square.sum(axis=-1, keepdims=True) - square
