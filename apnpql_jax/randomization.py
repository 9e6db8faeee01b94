"""Domain randomisation: every episode has a world of its own (paper Sec. V-C).

What is drawn goes into ``PhysicsState.fields``, which both engines, the kinematics and
the cameras read, so it costs no recompilation and videos show it. Constants that MuJoCo
derives from masses and sizes are derived here, too; for a body that floats freely they
are products of powers of its mass and its size.

The table stays where it is: it is the robot that stands lower or higher, tilted or
turned on it. Tasks can then go on to measure from the table.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.config import RandomizationConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.physics import GRIPPER_SPEED, PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

WRIST_SHARE = 0.1
"""How much less than the global camera that on the wrist is shifted."""

SQUARES = (0.015, 0.15)
"""m; edges of a checker's squares."""

WAVES = (0.02, 0.3)
"""m; from crest to crest of noise."""

Randomize = Callable[[PhysicsState, Array], PhysicsState]
"""(states at rest [worlds, ...], keys [worlds]) -> the same in worlds of their own."""


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

  def __init__(self, scene: Scene, fields: dict[str, Array]):
    self.model = scene.model
    self.fields = dict(fields)

  def __getitem__(self, name: str) -> Array:
    """A model field, f32[...]."""
    present = self.fields.get(name)
    if present is not None:
      return present
    return jnp.asarray(getattr(self.model, name), jnp.float32)

  def __setitem__(self, name: str, value: Array) -> None:
    self.fields[name] = value


def make_randomize(config: RandomizationConfig, scene: Scene) -> Randomize:
  """The function that gives episodes worlds of their own."""

  def one(state: PhysicsState, key: Array) -> PhysicsState:
    draw, world = Draw(key, config), World(scene, state.fields)
    _color(draw, world)
    _texture(draw, world)
    _light(draw, world)
    _cameras(draw, world)
    _table(draw, world)
    qpos = _size(draw, world, state.qpos)
    _mass(draw, world)
    _contacts(draw, world)
    command = _control(draw, world, scene, qpos)
    return state.replace(qpos=qpos, fields=world.fields, command=command)

  return jax.vmap(one)


def _groups(model: mujoco.MjModel) -> np.ndarray:
  """i32[ngeom]: what looks alike: the robot, the table, each object."""
  return model.body_rootid[model.geom_bodyid]


def _objects(model: mujoco.MjModel) -> np.ndarray:
  """bool[nbody]: the bodies that float freely."""
  joint = model.body_jntadr
  kind = np.append(model.jnt_type, -1)[joint]  # Without a joint the address is -1.
  return kind == mujoco.mjtJoint.mjJNT_FREE


def _color(draw: Draw, world: World) -> None:
  if not draw.config.color:
    return
  change = draw.uniform("color", (world.model.nbody + 1, 3))
  rgb = world["geom_rgba"][:, :3] + change[_groups(world.model)]
  alpha = world["geom_rgba"][:, 3:]
  world["geom_rgba"] = jnp.concatenate([rgb.clip(0.0, 1.0), alpha], axis=-1)
  background = jnp.asarray(Lighting().background, jnp.float32)
  world["background"] = (background + change[-1]).clip(0.0, 1.0)


def _texture(draw: Draw, world: World) -> None:
  """A third of the groups each is plain, checkered and noisy."""
  if not draw.config.texture:
    return
  groups, bodies = _groups(world.model), world.model.nbody
  kind, side, turn, phase = jax.random.split(draw.stream("texture"), 4)
  kind = jax.random.randint(kind, (bodies,), 0, 3)
  change = draw.uniform("texture", (bodies, 3))
  # A checker's squares are half waves; a plane has none across it.
  low, high = np.log(SQUARES)
  edge = jnp.exp(jax.random.uniform(side, (bodies, 1, 1), jnp.float32, low, high))
  checker = (jnp.eye(3) * 0.5 / edge)[groups]
  flat = world.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  checker = (
    checker * jnp.where(flat[:, None] & (np.arange(3) == 2), 0.0, 1.0)[..., None]
  )
  noise = jax.random.normal(turn, (bodies, 3, 3))
  noise = noise / jnp.linalg.norm(noise, axis=-1, keepdims=True)
  noise = noise / np.geomspace(*WAVES, 3, dtype=np.float32)[:, None]
  vectors = jnp.where((kind == 2)[groups][:, None, None], noise[groups], checker)
  phase = jax.random.uniform(phase, (bodies, 3, 1))[groups]
  world["geom_waves"] = jnp.concatenate([vectors, phase], axis=-1)
  rgb = world["geom_rgba"][:, :3]
  other = (rgb + change[groups]).clip(0.0, 1.0)
  world["geom_odd_rgb"] = jnp.where((kind == 1)[groups][:, None], other, rgb)
  # Noise only darkens, so what it takes may be as much as two changes.
  grain = jnp.where(kind == 2, 2.0 * jnp.abs(change[:, 0]), 0.0)
  world["geom_grain"] = grain[groups]


def _light(draw: Draw, world: World) -> None:
  if draw.config.light_turn:
    toward = world["light_dir"]
    world["light_dir"] = toward + draw.uniform("light_turn", toward.shape)
  if draw.config.light_level:
    plain, ones = Lighting(), jnp.ones_like(world["light_ambient"])
    ambient, diffuse = draw.share("light_level", (2,)) * jnp.asarray(
      [plain.ambient, plain.diffuse], jnp.float32
    )
    # No brighter than all there is: colours would be cut off.
    most = jnp.maximum(1.0, ambient + diffuse)
    world["light_ambient"] = ambient / most * ones
    world["light_diffuse"] = diffuse / most * ones


def _cameras(draw: Draw, world: World) -> None:
  config, count = draw.config, world.model.ncam
  if config.camera_shift:
    far = np.where(world.model.cam_bodyid == 0, 1.0, WRIST_SHARE).astype(np.float32)
    shift = draw.uniform("camera_shift", (count, 3))
    world["cam_pos"] = world["cam_pos"] + far[:, None] * shift
  if config.camera_turn:
    turn = draw.uniform("camera_turn", (count, 3))
    world["cam_quat"] = _turned(world["cam_quat"], turn)
  if config.field_of_view:
    world["cam_fovy"] = world["cam_fovy"] * draw.share("field_of_view", (count,))


def _table(draw: Draw, world: World) -> None:
  config, base = draw.config, world.model.body("base").id
  if config.table_height:
    lower = jnp.append(jnp.zeros(2), -draw.uniform("table_height"))
    world["body_pos"] = world["body_pos"].at[base].add(lower)
  if config.table_tilt or config.table_turn:
    turn = jnp.append(draw.uniform("table_tilt", (2,)), draw.uniform("table_turn"))
    quat = world["body_quat"]
    # In the world's axes, hence the inverse of a turn in the base's.
    level = _turned(_inverse(quat[base]), -turn)
    world["body_quat"] = quat.at[base].set(_inverse(level))


def _size(draw: Draw, world: World, qpos: Array) -> Array:
  """Scales objects about their frames; returns where they stand on the table."""
  if not draw.config.size:
    return qpos
  model, objects = world.model, _objects(world.model)
  scale = jnp.where(objects, draw.share("size", (model.nbody,)), 1.0)
  of_geom = scale[model.geom_bodyid][:, None]
  for name in ("geom_size", "geom_pos", "geom_aabb"):
    world[name] = world[name] * of_geom
  world["geom_rbound"] = world["geom_rbound"] * of_geom[:, 0]
  world["body_ipos"] = world["body_ipos"] * scale[:, None]
  _weigh(world, jnp.ones_like(scale), scale)
  heights = model.jnt_qposadr[model.body_jntadr[objects]] + 2
  return qpos.at[heights].multiply(scale[objects])


def _mass(draw: Draw, world: World) -> None:
  if not draw.config.mass:
    return
  objects = _objects(world.model)
  factor = jnp.where(objects, draw.share("mass", (world.model.nbody,)), 1.0)
  gained = (factor - 1.0) * world["body_mass"]
  world["body_mass"] = world["body_mass"] * factor
  whole = world["body_subtreemass"] + gained
  world["body_subtreemass"] = whole.at[0].add(gained.sum())
  _weigh(world, factor, jnp.ones_like(factor))


def _weigh(world: World, mass: Array, size: Array) -> None:
  """What follows for inertias from factors of mass and size, f32[nbody] each."""
  model = world.model
  turning = mass * size**2
  world["body_inertia"] = world["body_inertia"] * turning[:, None]
  inverse = jnp.stack([1.0 / mass, 1.0 / turning], axis=-1)
  world["body_invweight0"] = world["body_invweight0"] * inverse
  # A free joint moves along three axes, then turns about three.
  rank = np.arange(model.nv) - model.body_dofadr[model.dof_bodyid]
  weight = jnp.where(rank < 3, mass[model.dof_bodyid], turning[model.dof_bodyid])
  world["dof_M0"] = world["dof_M0"] * weight
  world["dof_invweight0"] = world["dof_invweight0"] / weight


def _contacts(draw: Draw, world: World) -> None:
  if draw.config.friction:
    world["pair_friction"] = world["pair_friction"] * draw.share("friction")


def _control(draw: Draw, world: World, scene: Scene, qpos: Array) -> Array | None:
  """Damping, gripper and delay; returns what commands begin with if they are late."""
  config, model = draw.config, world.model
  if config.damping:
    robot = model.body_rootid[model.dof_bodyid] == model.body("base").id
    rate = jnp.abs(draw.uniform("damping", (model.nv,)))
    added = jnp.where(robot, rate * world["dof_M0"], 0.0)
    world["dof_damping"] = world["dof_damping"] + added
  if config.gripper_speed:
    world["gripper_speed"] = GRIPPER_SPEED * draw.share("gripper_speed")
  if not config.delay_s:
    return None
  longest = round(config.delay_s / model.opt.timestep)
  steps = jax.random.randint(draw.stream("delay_s"), (), 0, longest + 1)
  world["control_delay"] = steps.astype(jnp.float32)
  closed = (qpos[scene.gripper_qpos] > 0.5).astype(jnp.float32)
  return jnp.append(jnp.zeros(6), closed)


def _turned(quat: Array, turn: Array) -> Array:
  """Unit quaternions f32[*b, 4] after small turns f32[*b, 3] about their own axes."""
  w, x, y, z = jnp.moveaxis(quat, -1, 0)
  a, b, c = jnp.moveaxis(0.5 * turn, -1, 0)
  turned = jnp.stack(
    [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c,
     z + w * c + x * b - y * a], axis=-1
  )  # fmt: skip
  return turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)


def _inverse(quat: Array) -> Array:
  return quat * jnp.asarray([1.0, -1.0, -1.0, -1.0])
