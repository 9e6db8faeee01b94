"""AP-NPQL learns a manipulation task without physics within a minute.

A point in R^6 with a gripper must go to an object, close there, and carry it to a
goal: reward +1 once, 15 steps. Its action primitives are the paper's: towards the
object, the goal, and a neutral place. A quarter of each batch is an expert's.
"""

from __future__ import annotations

from typing import NamedTuple

from flax import struct
import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import LearnerState, make_agent
from apnpql_jax.config import AgentConfig
from apnpql_jax.types import Observation, Transition

WORLDS = 32
LIMIT = 15
RADIUS = 0.35
STEP = 0.4
GAMMA = 0.95
CAPACITY = 16_384
CONFIG = AgentConfig(
  hidden=(64, 64),
  feature_dim=64,
  target_samples=40,
  policy_samples=40,
  learning_rate_e=1e-3,
  learning_rate_m=1e-3,
  learning_rate_alpha=1e-3,
  learning_rate_nu=1e-3,
  epsilon=1.5,
  epsilon_nu=-3.0,
)


class World(NamedTuple):
  point: jax.Array  # f32[W, 6]
  history: jax.Array  # f32[W, 3, 7]
  places: jax.Array  # f32[W, 3, 6]: object, goal, neutral
  holding: jax.Array  # bool[W]
  time: jax.Array  # i32[W]


@struct.dataclass
class Buffer:
  rows: Transition  # [CAPACITY, ...]
  cursor: jax.Array


def reset(key: jax.Array) -> World:
  key_point, key_places = jax.random.split(key)
  point = jax.random.uniform(key_point, (WORLDS, 6), minval=-0.5, maxval=0.5)
  places = jax.random.uniform(key_places, (WORLDS, 3, 6), minval=-1.0)
  places = places.at[:, 2].set(0.0)
  history = jnp.concatenate([point, jnp.zeros((WORLDS, 1))], axis=-1)
  return World(
    point,
    jnp.repeat(history[:, None], 3, axis=1),
    places,
    jnp.zeros(WORLDS, bool),
    jnp.zeros(WORLDS, jnp.int32),
  )


def observe(world: World) -> Observation:
  places = world.places[:, :2].reshape(WORLDS, -1)
  holding = world.holding.astype(jnp.float32)[:, None]
  return Observation(
    robot=world.history.reshape(WORLDS, -1),
    objects=jnp.concatenate([places, holding], axis=-1),
  )


def primitives(world: World) -> jax.Array:
  velocity = (world.places - world.point[:, None]) / STEP
  size = jnp.max(jnp.abs(velocity), axis=-1, keepdims=True)
  return velocity / jnp.maximum(size, 1.0)


def step(world: World, action: jax.Array) -> tuple[World, jax.Array]:
  """Grasps, then moves the point; True where the object, held, is at the goal."""
  closed = action[:, 6] > 0.5
  holding = closed & (world.holding | near(world, 0))
  point = world.point + STEP * action[:, :6]
  newest = jnp.concatenate([point, closed[:, None].astype(jnp.float32)], axis=-1)
  history = jnp.concatenate([world.history[:, 1:], newest[:, None]], axis=1)
  moved = World(point, history, world.places, holding, world.time + 1)
  return moved, holding & near(moved, 1)


def near(world: World, place: int) -> jax.Array:
  """True where the point is within reach of the place."""
  return jnp.linalg.norm(world.point - world.places[:, place], axis=-1) < RADIUS


def expert(world: World, key: jax.Array) -> jax.Array:
  """Follows one primitive after the other, with noise."""
  close = world.holding | near(world, 0)
  velocity = jnp.where(
    close[:, None], primitives(world)[:, 1], primitives(world)[:, 0]
  )
  velocity = velocity + 0.1 * jax.random.normal(key, velocity.shape)
  velocity = jnp.clip(velocity, -1.0, 1.0)
  return jnp.concatenate([velocity, close[:, None].astype(jnp.float32)], axis=-1)


def where(mask: jax.Array, a: World, b: World) -> World:
  def choose(x: jax.Array, y: jax.Array) -> jax.Array:
    return jnp.where(mask.reshape((-1,) + (1,) * (x.ndim - 1)), x, y)

  return jax.tree.map(choose, a, b)


AGENT = make_agent(CONFIG)


def agent_policy(state: LearnerState):
  def policy(world: World, key: jax.Array) -> jax.Array:
    return AGENT.act(state.params, observe(world), key, False)[0]

  return policy


def play(policy, world: World, key: jax.Array) -> tuple[World, Transition]:
  """One step of every world, with autoreset."""
  key_act, key_reset = jax.random.split(key)
  action = policy(world, key_act)
  moved, success = step(world, action)
  transition = Transition(
    observation_tm1=observe(world),
    action_tm1=action,
    reward_t=success.astype(jnp.float32),
    discount_t=GAMMA * (1.0 - success.astype(jnp.float32)),
    observation_t=observe(moved),
    primitives_tm1=primitives(world),
    weight=jnp.ones(WORLDS),
  )
  done = success | (moved.time >= LIMIT)
  return where(done, reset(key_reset), moved), transition


def rollout(policy, world: World, key: jax.Array, length: int):
  """Plays ``length`` steps; rows [length * WORLDS, ...]."""

  def body(world: World, key: jax.Array):
    return play(policy, world, key)

  world, rows = jax.lax.scan(body, world, jax.random.split(key, length))
  return world, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)


def draw(rows: Transition, held: jax.Array, num: int, key: jax.Array) -> Transition:
  chosen = jax.random.randint(key, (num,), 0, held)
  return jax.tree.map(lambda x: x[chosen], rows)


def train_step(carry, key: jax.Array):
  """Two control steps of all worlds, then four updates on uniform batches."""
  state, world, buffer, demos = carry
  key_play, key_learn = jax.random.split(key)
  world, new = rollout(agent_policy(state), world, key_play, 2)
  at = buffer.cursor % CAPACITY
  rows = jax.tree.map(
    lambda old, x: jax.lax.dynamic_update_slice_in_dim(old, x, at, axis=0),
    buffer.rows,
    new,
  )
  buffer = Buffer(rows, buffer.cursor + 2 * WORLDS)

  def learn(state: LearnerState, key: jax.Array):
    keys = jax.random.split(key, 3)
    own = draw(buffer.rows, jnp.minimum(buffer.cursor, CAPACITY), 48, keys[0])
    shown = draw(demos, demos.weight.size, 16, keys[1])
    batch = jax.tree.map(lambda *x: jnp.concatenate(x), own, shown)
    return AGENT.update(state, batch, keys[2])

  state, metrics = jax.lax.scan(learn, state, jax.random.split(key_learn, 4))
  return (state, world, buffer, demos), jax.tree.map(lambda x: x[-1], metrics)


def success_rate(policy, key: jax.Array) -> jax.Array:
  """Share of the worlds solved in one episode each."""
  key_reset, key_play = jax.random.split(key)

  def body(carry, key: jax.Array):
    world, solved = carry
    world, success = step(world, policy(world, key))
    return (world, solved | success), None

  start = (reset(key_reset), jnp.zeros(WORLDS, bool))
  keys = jax.random.split(key_play, LIMIT)
  return jnp.mean(jax.lax.scan(body, start, keys)[0][1])


def begin(key: jax.Array):
  keys = jax.random.split(key, 3)
  world = reset(keys[0])
  state = AGENT.init(keys[1], observe(world))
  _, demos = rollout(expert, world, keys[2], 2 * LIMIT)
  rows = jax.tree.map(lambda x: jnp.zeros((CAPACITY, *x.shape[1:]), x.dtype), demos)
  return state, world, Buffer(rows, jnp.zeros((), jnp.int32)), demos
