"""The environments in the manner of Brax and MuJoCo Playground.

    env = FunctionalEnv(load_preset("push_plate").env)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 32))
    state = jax.jit(jax.vmap(env.step))(state, actions)

``reset`` and ``step`` are pure and written for one world. ``jax.vmap`` turns them into
one program of the batched ``Env``, with either engine.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

from flax import struct
import jax
from jax.custom_batching import custom_vmap
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState, truncate_faults
from apnpql_jax.types import ACTION_DIM, Array


class State(struct.PyTreeNode):
  """The state of a world, with the fields of ``brax.envs.State``."""

  pipeline_state: EnvState
  """State of the simulation, ``Env``'s without the axis of worlds."""

  obs: dict[str, Array]
  """Fields of ``types.Observation``."""

  reward: Float[Array, ""]
  """1 at the instant of success, otherwise 0."""

  done: Float[Array, ""]
  """1 if the episode is over; the next step begins another one."""

  metrics: dict[str, Array]
  """``success``: whether the task is solved."""

  info: dict[str, Any]
  """``truncation``: whether the time ran out or the world broke; ``fault``: whether it
  broke; ``rng``: key of the world."""


class FunctionalEnv:
  """A task as pure functions ``reset(rng)`` and ``step(state, action)``.

  A step from a state that is done ignores the action and returns the first state of a
  random episode, so no wrapper for resets is needed. What wrappers add to ``metrics``
  and ``info`` is kept. A world that becomes non-finite is done and keeps its last
  finite observation.
  """

  action_size = ACTION_DIM
  """Joint velocities in [-1, 1] rad/s, and the gripper, which closes where its command
  is positive, as in Gymnasium: 0 and 1 work, and so do policies in [-1, 1]."""

  def __init__(self, config: EnvConfig):
    """Builds the environment; ``worlds`` of the settings has no effect.

    Raises:
      ConfigError: See ``make_env``.
    """
    self.env: Env = make_env(config)
    self.reset = _over_worlds(self._reset)
    self.step = _over_worlds(self._step)

  @property
  def observation_size(self) -> dict[str, tuple[int, ...]]:
    """The shape of each observation."""
    obs = jax.eval_shape(self.reset, jax.random.key(0)).obs
    return {name: x.shape for name, x in obs.items()}

  def _reset(self, rng: PRNGKeyArray) -> State:
    rows, keys, rng = self._draw(rng)
    return _state(self.env.reset(rows, keys), rng)

  def _step(self, state: State, action: Float[Array, "worlds 7"]) -> State:
    rows, keys, rng = self._draw(state.info["rng"])
    before = state.pipeline_state
    action = action.at[:, -1].set(action[:, -1] > 0.0)
    arrival = self.env.advance_or_begin(before, action, rows, keys)
    worlds = truncate_faults(before, self.env.observe(arrival))
    after = _state(worlds, rng, before.faults)
    metrics, info = state.metrics | after.metrics, state.info | after.info
    return after.replace(metrics=metrics, info=info)

  def _draw(self, rng: PRNGKeyArray) -> tuple[Array, PRNGKeyArray, PRNGKeyArray]:
    """Draws a row of the bank and a key for each world; returns the next keys, too."""
    split = jax.vmap(lambda key: jax.random.split(key, 3))(rng)
    row = functools.partial(jax.random.randint, minval=0, maxval=self.env.bank_split)
    rows = jax.vmap(lambda key: row(key, ()))(split[:, 0])
    return rows, split[:, 1], split[:, 2]


def _state(worlds: EnvState, rng: PRNGKeyArray, faults: Array | int = 0) -> State:
  """Returns the state after a step; ``faults`` are those before it, i32[worlds]."""
  timestep = worlds.timestep
  return State(
    pipeline_state=worlds,
    obs=worlds.observation.present(),
    reward=timestep.reward,
    done=timestep.last.astype(jnp.float32),
    metrics={"success": timestep.terminated.astype(jnp.float32)},
    info={
      "truncation": timestep.truncated.astype(jnp.float32),
      "fault": (worlds.faults > faults).astype(jnp.float32),
      "rng": rng,
    },
  )


def _over_worlds(function: Callable[..., State]) -> Callable[..., State]:
  """Turns a function of [worlds, ...] into one of a world that ``vmap`` turns back.

  Nested ``vmap`` axes are merged into the worlds axis: C MuJoCo's call has only one.
  """
  batched = custom_vmap(function)

  @custom_vmap
  def single(*args: Any) -> State:
    result = batched(*jax.tree.map(lambda x: x[None], args))
    return jax.tree.map(lambda x: x[0], result)

  @single.def_vmap
  def first(size: int, is_batched: Any, *args: Any) -> tuple[State, Any]:
    result = batched(*_spread(size, is_batched, args))
    return result, jax.tree.map(lambda _: True, result)

  @batched.def_vmap
  def further(size: int, is_batched: Any, *args: Any) -> tuple[State, Any]:
    args = _spread(size, is_batched, args)
    merged = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), args)
    result = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), batched(*merged))
    return result, jax.tree.map(lambda _: True, result)

  return single


def _spread(size: int, is_batched: Any, args: tuple[Any, ...]) -> tuple[Any, ...]:
  """Returns the arguments of a rule of ``vmap``, all of them with its axis."""

  def spread(x: Array, has_axis: bool) -> Array:
    return x if has_axis else jnp.broadcast_to(x, (size, *x.shape))

  return jax.tree.map(spread, args, tuple(is_batched))
