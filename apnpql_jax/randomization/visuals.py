"""Colors, textures and light of a world."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.randomization.draw import Draw, World
from apnpql_jax.render import Lighting

SQUARES = (0.015, 0.15)  # m; edges of a checker's squares
WAVES = (0.02, 0.3)  # m; wavelengths of noise


def color(draw: Draw, world: World) -> None:
  """Changes the colors of robot, table, each object and the background separately."""
  if not (draw.config.color or draw.config.surroundings):
    return
  change = draw.uniform("color", (world.model.nbody + 1, 3))
  if draw.config.surroundings:
    # The table belongs to the world, body 0; the background is the last.
    change = change.at[np.array([0, -1])].add(draw.uniform("surroundings", (2, 3)))
  rgb, alpha = jnp.split(world["geom_rgba"], [3], axis=-1)
  rgb = (rgb + change[_groups(world.model)]).clip(0.0, 1.0)
  world["geom_rgba"] = jnp.concatenate([rgb, alpha], axis=-1)
  world["background"] = (world["background"] + change[-1]).clip(0.0, 1.0)


def texture(draw: Draw, world: World) -> None:
  """Makes each group and the background plain, checkered or noisy, at equal odds."""
  if not draw.config.texture:
    return
  model, count = world.model, world.model.nbody + 1
  groups = np.append(_groups(model), model.nbody)  # The background is the last.
  kind, side, turn, phase = jax.random.split(draw.stream("texture"), 4)
  kind = jax.random.randint(kind, (count,), 0, 3)
  change = draw.uniform("texture", (count, 3))

  # A checker's squares are half waves along the axes; a plane has none across it.
  low, high = np.log(SQUARES)
  edge = jnp.exp(jax.random.uniform(side, (count, 1, 1), jnp.float32, low, high))
  plane = np.append(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, False)
  varies = jnp.where(plane[:, None] & (np.arange(3) == 2), 0.0, 1.0)
  checker = (jnp.eye(3) * 0.5 / edge)[groups] * varies[..., None]

  # Noise is three waves in random directions.
  noise = jax.random.normal(turn, (count, 3, 3))
  noise = noise / jnp.linalg.norm(noise, axis=-1, keepdims=True)
  noise = noise / np.geomspace(*WAVES, 3, dtype=np.float32)[:, None]
  vectors = jnp.where((kind == 2)[groups][:, None, None], noise[groups], checker)
  phase = jax.random.uniform(phase, (count, 3, 1))[groups]
  world["waves"] = jnp.concatenate([vectors, phase], axis=-1)

  # Odd squares have another color. Noise only darkens, so it may change twice as much.
  rgb = jnp.concatenate([world["geom_rgba"][:, :3], world["background"][None]])
  other = (rgb + change[groups]).clip(0.0, 1.0)
  world["odd_rgb"] = jnp.where((kind == 1)[groups][:, None], other, rgb)
  world["grain"] = jnp.where(kind == 2, 2.0 * jnp.abs(change[:, 0]), 0.0)[groups]


def light(draw: Draw, world: World) -> None:
  """Changes the direction and the brightness of the light."""
  if draw.config.light_turn:
    world["light_dir"] += draw.uniform("light_turn", world["light_dir"].shape)
  if draw.config.light_level:
    plain, ones = Lighting(), jnp.ones_like(world["light_ambient"])
    factor = draw.factor("light_level", (2,))
    ambient, diffuse = factor * jnp.asarray([plain.ambient, plain.diffuse], jnp.float32)
    # Keep the sum within one, where colors would be clipped.
    most = jnp.maximum(1.0, ambient + diffuse)
    world["light_ambient"] = ambient / most * ones
    world["light_diffuse"] = diffuse / most * ones


def _groups(model: mujoco.MjModel) -> np.ndarray:
  """Returns the group i32[ngeom] of each geom: the robot, the table or an object."""
  return model.body_rootid[model.geom_bodyid]
