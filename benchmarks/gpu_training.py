"""Training in gpu_suite.py: push_plate from pixels, with settings for a GPU."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import sys
import time
from typing import Any

from gpu_measure import Settings, emit, lock, measuring, memory
import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.evaluate import figures_of, play_held_out
from apnpql_jax.training.expert import collect_expert, empty_expert
from apnpql_jax.training.iteration import make_iteration
from apnpql_jax.training.rollout import agent_policy, make_player
from apnpql_jax.training.state import initial_state


def agent_config(settings: Settings) -> AgentConfig:
  """The preset's agent with the candidates asked for."""
  config = load_preset("push_plate").agent
  return dataclasses.replace(
    config,
    target_samples=settings["candidates"],
    policy_samples=settings["candidates"],
  )


def training_config(settings: Settings, worlds: int) -> TrainConfig:
  """The preset of push_plate for a GPU: more worlds, a batch that grows with them.

  As on a CPU, updates see 16 transitions for every environment step.
  """
  base, batch = load_preset("push_plate"), settings["train_batch"]
  steps = base.rollout_length * worlds
  share = base.updates_per_iteration * base.replay.batch_size
  share = share / (base.rollout_length * base.env.worlds)
  return dataclasses.replace(
    base,
    env=dataclasses.replace(
      base.env,
      backend=settings["backend"],
      worlds=worlds,
      bank_rows=settings["bank_rows"],
    ),
    agent=agent_config(settings),
    replay=dataclasses.replace(
      base.replay,
      batch_size=batch,
      capacity=settings["replay_periods"] * worlds,
      expert_steps=settings["expert_periods"] * worlds,
    ),
    updates_per_iteration=max(1, round(share * steps / batch)),
  )


def train(settings: Settings) -> None:
  """Trains on push_plate from pixels for some minutes, then plays held-out episodes.

  Everything is compiled before, while other sections are at work; a line of standard
  input starts the clock.
  """
  config = training_config(settings, settings["train_worlds"])
  episodes = settings["eval_episodes"]
  env, agent = make_env(config.env), make_agent(config.agent)
  iteration: Any = make_iteration(config, env, agent)
  play: Any = make_player(env, lambda params: agent_policy(agent, params, greedy=False))
  example = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  rows, key = jnp.zeros(episodes, jnp.int32), jax.random.key(0)

  def compiled() -> tuple[Any, float]:
    began = time.perf_counter()
    program = iteration.lower(example).compile()
    return program, time.perf_counter() - began

  with (
    lock(settings, "compile", shared=True),
    concurrent.futures.ThreadPoolExecutor(3) as pool,
  ):
    first = pool.submit(compiled)
    player = pool.submit(
      lambda: play.lower(example.learner.target_params, rows, key).compile()
    )
    state = initial_state(config, env, agent, collect_expert)
    (program, compile_s), play = first.result(), player.result()
    jax.clear_caches()
    _, from_cache_s = compiled()
  emit(
    what="before training",
    worlds=config.env.worlds,
    updates_per_iteration=config.updates_per_iteration,
    compile_s=compile_s,
    compile_from_cache_s=from_cache_s,
    **memory(program),
  )
  terms = json.loads(sys.stdin.readline())
  with measuring(settings):
    until = min(time.time() + terms["seconds"], terms["until"])
    state = _train_until(until, program, state, config)
    began = time.perf_counter()
    played = play_held_out(
      env, play, state.learner.target_params, episodes=episodes, seed=0
    )
    seconds = time.perf_counter() - began
    emit(what="held-out episodes", seconds=seconds, **figures_of(played))


def _train_until(until: float, program: Any, state: Any, config: TrainConfig) -> Any:
  """Iterates, and reports every few seconds how episodes of training ended."""
  began = reported = time.time()
  successes = timeouts = 0
  while (now := time.time()) < until:
    state, metrics = program(state)
    successes += int(metrics["rollout/successes"])
    timeouts += int(metrics["rollout/timeouts"])
    if now - reported > 5.0:
      emit(
        what=f"training, {now - began:.0f} s",
        env_steps=int(state.env_steps),
        updates=int(state.learner.step),
        steps_per_s=int(state.env_steps) / (time.time() - began),
        success_rate=successes / max(successes + timeouts, 1),
        skipped_updates=int(metrics["faults/updates"]),
      )
      reported, successes, timeouts = now, 0, 0
  emit(
    what="training",
    seconds=time.time() - began,
    env_steps=int(state.env_steps),
    updates=int(state.learner.step),
    **memory(program),
  )
  return state
