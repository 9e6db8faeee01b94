"""The randomization of worlds: a separate one is drawn for every episode.

The values go into ``PhysicsState.fields``, which both engines, the kinematics and the
cameras read. So they need no recompilation, and videos show them. The table stays in
place and the robot stands lower or higher, tilted or turned on it, so that tasks can
measure from the table.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax.config.ranges import WRIST_SHARE, RandomizationConfig
from apnpql_jax.randomization import objects, visuals
from apnpql_jax.randomization.draw import Draw, World
from apnpql_jax.sim.motors import GRIPPER_SPEED
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene, fixed_bodies
from apnpql_jax.types import Array

SEEN = (
  "color surroundings texture light_turn light_level camera_shift camera_turn "
  "field_of_view"
).split()
"""Ranges of what the cameras see and the physics does not depend on."""

Randomize = Callable[[PhysicsState, Array], PhysicsState]  # of states at rest and keys


def make_randomize(config: RandomizationConfig, scene: Scene) -> Randomize:
  """Returns the function that draws a world for each episode.

  Raises:
    ConfigError: The objects of the scene cannot change as ``config`` says.
  """
  objects.check(config, scene)

  def one(state: PhysicsState, key: PRNGKeyArray) -> PhysicsState:
    draw, world = Draw(key, config), World(scene.model, state.fields)
    visuals.color(draw, world)
    visuals.texture(draw, world)
    visuals.light(draw, world)
    _cameras(draw, world)
    _base(draw, world)
    qpos = objects.scale(draw, world, state.qpos)
    objects.weigh(draw, world)
    if config.size or config.shape or config.mass:
      objects.derive(world)
    if config.friction:
      factor = draw.factor("friction")
      world["pair_friction"] *= factor
      if (scene.model.geom_contype[:, None] & scene.model.geom_conaffinity).any():
        world["geom_friction"] *= factor  # Of contacts that no pair lists.
    command = _control(draw, world, scene, qpos)
    return state.replace(qpos=qpos, fields=dict(world), command=command)

  return jax.vmap(one)


def seen_only(config: RandomizationConfig) -> RandomizationConfig:
  """Returns the ranges of what changes only what the cameras see.

  In another physical world, the states of a demonstration would not follow from its
  actions: the hand would miss a larger object, or stand above a lower table.
  """
  plain = {f.name: 0.0 for f in dataclasses.fields(config) if f.name not in SEEN}
  return dataclasses.replace(config, **plain)


def _cameras(draw: Draw, world: World) -> None:
  config, count = draw.config, world.model.ncam
  if config.camera_shift:
    fixed = fixed_bodies(world.model)[world.model.cam_bodyid]
    share = np.where(fixed, 1.0, WRIST_SHARE).astype(np.float32)
    world["cam_pos"] += share[:, None] * draw.uniform("camera_shift", (count, 3))
  if config.camera_turn:
    turn = draw.uniform("camera_turn", (count, 3))
    world["cam_quat"] = _turned(world["cam_quat"], turn)
  if config.field_of_view:
    world["cam_fovy"] *= draw.factor("field_of_view", (count,))


def _base(draw: Draw, world: World) -> None:
  config, base = draw.config, world.model.body("base").id
  if config.table_height:
    lower = jnp.append(jnp.zeros(2), -draw.uniform("table_height"))
    world["body_pos"] = world["body_pos"].at[base].add(lower)
  if config.table_tilt or config.table_turn:
    turn = jnp.append(draw.uniform("table_tilt", (2,)), draw.uniform("table_turn"))
    quat = world["body_quat"]
    # About the world's axes: the inverse of a turn about the base's own axes.
    level = _turned(_inverse(quat[base]), -turn)
    world["body_quat"] = quat.at[base].set(_inverse(level))


def _control(draw: Draw, world: World, scene: Scene, qpos: Array) -> Array | None:
  """Draws damping, gripper and delay; returns the first command where it is delayed."""
  config, model = draw.config, world.model
  if config.damping:
    robot = model.body_rootid[model.dof_bodyid] == model.body("base").id
    rate = jnp.abs(draw.uniform("damping", (model.nv,)))
    world["dof_damping"] += jnp.where(robot, rate * world["dof_M0"], 0.0)
  if config.gripper_speed:
    world["gripper_speed"] = GRIPPER_SPEED * draw.factor("gripper_speed")
  if not config.delay_s:
    return None
  longest = round(config.delay_s / model.opt.timestep)
  steps = jax.random.randint(draw.stream("delay_s"), (), 0, longest + 1)
  world["control_delay"] = steps.astype(jnp.float32)
  closed = (qpos[scene.gripper_qpos] > 0.5).astype(jnp.float32)
  return jnp.append(jnp.zeros(6), closed)


def _turned(quat: Array, turn: Array) -> Array:
  """Applies small turns f32[*b, 3] (rad) about own axes to quaternions f32[*b, 4]."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  a, b, c = jnp.moveaxis(0.5 * turn, -1, 0)
  turned = jnp.stack(
    [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c,
     z + w * c + x * b - y * a], axis=-1
  )  # fmt: skip
  return turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)


def _inverse(quat: Array) -> Array:
  return quat * jnp.asarray([1.0, -1.0, -1.0, -1.0])
