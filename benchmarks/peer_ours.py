"""This project's sides of peers.py: worlds of an engine, or the learner of a row.

Each compiles at its first measurement, which does not count.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import dataclasses
import functools
import json
import sys
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
from cures import cures
import jax
import jax.numpy as jnp
from learner import nth_update
import parts
from peer_worlds import EPISODE_STEPS
import sides
import tables

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig, EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.rollout import rollout
from apnpql_jax.types import Array, Transition

sys.path.append(str(tables.ROOT / "tests"))
from apnpql_jax.testing import random_batch


def worlds(settings: dict[str, Any]) -> dict[str, sides.Measure]:
  """Control steps of all worlds: whole, or physics only."""
  config = EnvConfig(
    task=settings["task"], backend=settings["backend"], worlds=settings["worlds"]
  )
  periods = settings["periods"]  # Per call.
  env = make_env(config)
  start = env.reset(jnp.arange(config.worlds) % env.bank_split)

  @jax.jit
  def whole(state: EnvState, key: Array) -> EnvState:
    return rollout(env, parts.random_policy, state, key, length=periods)[0]

  def period(state: Any, key: Array) -> tuple[Any, None]:
    action = parts.random_actions(key, config.worlds)
    return env.physics.step(state, action[:, :6], action[:, 6]), None

  @jax.jit
  def physics(state: Any, key: Array) -> Any:
    stock = cures(barrier=False, cones=False)
    with stock if settings["stock"] else contextlib.nullcontext():
      return jax.lax.scan(period, state, jax.random.split(key, periods))[0]

  return {
    "cameras": _played(whole, start, periods, config.worlds),
    "physics": _played(physics, start.physics, periods, config.worlds),
  }


def learner(settings: dict[str, Any]) -> dict[str, sides.Measure]:
  """Updates on a batch of noise, in a loop of as many as an iteration has."""
  preset = load_preset(settings["preset"])
  agent = make_agent(learner_config(settings))
  count = preset.updates_per_iteration
  batch = random_batch(0, settings["batch"], pixels=True)
  state = agent.init(jax.random.key(0), batch.observation_tm1)

  @jax.jit
  def updates(state: Any, batch: Transition) -> Any:
    update = functools.partial(nth_update, agent, batch)
    return jax.lax.fori_loop(0, count, update, state)

  def run() -> None:
    jax.block_until_ready(updates(state, batch))

  return {"updates": sides.rate_of(run, count)}


def learner_config(settings: dict[str, Any]) -> AgentConfig:
  """The agent of the preset with algorithm, candidates and features as asked for."""
  config = load_preset(settings["preset"]).agent
  if features := settings.get("features"):
    config = dataclasses.replace(
      config, global_features=features, wrist_features=features
    )
  return dataclasses.replace(
    config,
    algorithm=settings.get("algorithm", config.algorithm),
    target_samples=settings["candidates"],
    policy_samples=settings["candidates"],
    # Epsilon must stay below the log of the candidates; it costs no time.
    epsilon=min(config.epsilon, 1.0),
  )


def _played(
  advance: Callable[[Any, Array], Any], start: Any, periods: int, count: int
) -> sides.Measure:
  """Plays on from call to call, and from the start again after an episode."""
  now = {"state": start, "calls": 0}

  def run() -> None:
    key = jax.random.key(now["calls"])
    again = now["calls"] % (EPISODE_STEPS // periods) == 0
    state = advance(start if again else now["state"], key)
    now.update(state=jax.block_until_ready(state), calls=now["calls"] + 1)

  return sides.rate_of(run, periods * count)


def main(settings: dict[str, Any]) -> None:
  """Serves what ``settings["side"]`` names."""
  make = {"worlds": worlds, "learner": learner}[settings["side"]]
  sides.serve(make(settings), backend=jax.default_backend())


if __name__ == "__main__":
  main(json.loads(sys.argv[1]))
