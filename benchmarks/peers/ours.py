"""This project's sides of compare.py: worlds of an engine, or the learner of a row.

Each compiles at its first measurement, which does not count.
"""

from collections.abc import Callable
import contextlib
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.rollout import rollout
from apnpql_jax.types import Array, Transition
from benchmarks.common import noise, parts
from benchmarks.common.mjx_patching import patched
from benchmarks.common.settings import changed, with_candidates
from benchmarks.peers import sides
from benchmarks.peers.worlds import EPISODE_STEPS
from benchmarks.speed.learner import nth_update


def build(settings: sides.Settings) -> sides.Built:
  """Builds what ``settings["side"]`` names."""
  make = {"worlds": worlds, "learner": learner}[settings["side"]]
  return make(settings), {"backend": jax.default_backend()}


def worlds(settings: sides.Settings) -> dict[str, sides.Measure]:
  """Returns measures of control steps of all worlds: whole, or physics only."""
  config = EnvConfig(**{name: settings[name] for name in ("task", "backend", "worlds")})
  periods = settings["periods"]  # Per call.
  env = make_env(config)
  start = env.reset(jnp.arange(config.worlds) % env.bank_split)

  @jax.jit
  def whole(state: EnvState, key: PRNGKeyArray) -> EnvState:
    return rollout(env, parts.random_policy, state, key, length=periods)[0]

  def period(state: Any, key: PRNGKeyArray) -> tuple[Any, None]:
    action = parts.random_actions(key, config.worlds)
    return env.physics.step(state, action[:, :6], action[:, 6]), None

  @jax.jit
  def physics(state: Any, key: PRNGKeyArray) -> Any:
    stock = patched(barrier=False, cones=False)
    with stock if settings["stock"] else contextlib.nullcontext():
      return jax.lax.scan(period, state, jax.random.split(key, periods))[0]

  sizes = (periods, config.worlds)
  return {
    "cameras": _played(whole, start, *sizes),
    "physics": _played(physics, start.physics, *sizes),
  }


def learner(settings: sides.Settings) -> dict[str, sides.Measure]:
  """Returns a measure of updates on noise, in a loop as long as an iteration."""
  config = load_preset(settings["preset"])
  config = changed(config, "replay", batch_size=settings["batch"])
  config = with_candidates(config, settings["candidates"], settings["precision"])
  agent, batch = make_agent(config.agent), noise.transitions(config)
  state = agent.init(jax.random.key(0), batch.observation_tm1)
  count = config.updates_per_iteration

  @jax.jit
  def updates(state: Any, batch: Transition) -> Any:
    update = functools.partial(nth_update, agent, batch)
    return jax.lax.fori_loop(0, count, update, state)

  def run() -> None:
    jax.block_until_ready(updates(state, batch))

  return {"updates": sides.rate_of(run, count)}


def _played(
  advance: Callable[[Any, Array], Any], start: Any, periods: int, worlds: int
) -> sides.Measure:
  """Returns a measure that plays from call to call and restarts after an episode."""
  state, calls = start, 0

  def run() -> None:
    nonlocal state, calls
    again = calls % (EPISODE_STEPS // periods) == 0
    state = advance(start if again else state, jax.random.key(calls))
    jax.block_until_ready(state)
    calls += 1

  return sides.rate_of(run, periods * worlds)
