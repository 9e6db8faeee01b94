"""Held-out episodes: every world plays exactly one, from rows training never sees."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import devices
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.console import say
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.runs import checkpoint_reader, leaves, run_folder
from apnpql_jax.runs.metrics import wilson_interval
from apnpql_jax.training.rollout import (
  Episodes,
  Player,
  agent_policy,
  expert_policy,
  make_player,
)
from apnpql_jax.training.video import record_episodes

MAX_WORLDS = 64
"""Episodes played at once; more are played in turn."""


def play_held_out(
  env: Env, play: Player, params: Any, *, episodes: int, seed: int
) -> Episodes:
  """Plays ``episodes`` held-out episodes.

  The rows are a random order of all held-out ones, repeated if there are not enough.

  Returns:
    the episodes; the first of them can be filmed.
  """
  key = jax.random.key(seed)
  rng = np.random.default_rng(seed)
  orders = [rng.permutation(env.held_out) for _ in range(-(-episodes // env.held_out))]
  rows = env.bank_split + np.concatenate(orders)[:episodes]
  turns = math.ceil(episodes / MAX_WORLDS)
  size = math.ceil(episodes / turns)
  # The last turn is filled up, so that one compiled size serves all.
  padded = np.resize(rows, turns * size).reshape(turns, size)
  played = [
    play(params, jnp.asarray(r), jax.random.fold_in(key, i))
    for i, r in enumerate(padded)
  ]
  success, length = (
    np.concatenate([np.asarray(getattr(p, f)) for p in played])[:episodes]
    for f in ("success", "length")
  )
  return played[0].replace(success=success, length=length)


def figures_of(played: Episodes) -> dict[str, Any]:
  """episodes, successes, success_rate, ci95 (Wilson), mean_length (control periods)."""
  episodes, successes = len(played.success), int(played.success.sum())
  return {
    "episodes": episodes,
    "successes": successes,
    "success_rate": successes / episodes,
    "ci95": wilson_interval(successes, episodes),
    "mean_length": float(played.length.mean()),
  }


def evaluate(
  run_dir: Path,
  *,
  episodes: int,
  seed: int,
  backend: str | None = None,
  step: int | None = None,
  greedy: bool = False,
  video: Path | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes with a checkpoint of a run.

  Args:
    run_dir: the run folder.
    episodes: how many.
    seed: of rows and actions.
    backend: physics engine; the run's own if None.
    step: of the checkpoint; the newest if None.
    greedy: the candidate of highest value or, of a parametric policy, the mean acts.
    video: where to write the first episodes as a video; if that fails, a line on
      standard error says so.

  Raises:
    ConfigError: not a run folder, or no readable checkpoint.
  """
  began = time.monotonic()
  config = run_folder.open_run(run_dir).config
  checkpoint_reader.check(run_dir, step, config=config)
  env_config = dataclasses.replace(config.env, backend=backend or config.env.backend)
  env = make_env(env_config, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  example = jax.eval_shape(
    lambda rows: agent.init(jax.random.key(0), env.reset(rows).observation),
    jnp.zeros(1, jnp.int32),
  )
  devices.check_memory(leaves.nbytes(example), "the learner")
  found = checkpoint_reader.restore(run_dir, step, {"learner": example}, config=config)
  for line in found.damaged:
    say(line)
  learner = found.items["learner"]
  play = make_player(env, lambda params: agent_policy(agent, params, greedy=greedy))
  figures = _figures(
    env, play, learner.target_params, episodes=episodes, seed=seed, video=video
  )
  return {
    "task": config.env.task,
    "algorithm": config.agent.algorithm,
    "backend": env.physics.name,
    "greedy": greedy,
    **figures,
    "checkpoint_step": found.step,
    "wall_s": time.monotonic() - began,
  }


def evaluate_expert(
  env_config: EnvConfig,
  *,
  episodes: int,
  seed: int,
  noise: float,
  video: Path | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes with the task's scripted expert; see ``evaluate_run``."""
  began = time.monotonic()
  env = make_env(env_config)
  play = make_player(env, lambda _: expert_policy(env, noise=noise))
  figures = _figures(env, play, None, episodes=episodes, seed=seed, video=video)
  return {
    "task": env_config.task,
    "algorithm": "expert",
    "backend": env.physics.name,
    **figures,
    "checkpoint_step": None,
    "wall_s": time.monotonic() - began,
  }


def _figures(
  env: Env, play: Player, params: Any, *, episodes: int, seed: int, video: Path | None
) -> dict[str, Any]:
  """Those of held-out episodes, of which the first are filmed if there is a path."""
  played = play_held_out(env, play, params, episodes=episodes, seed=seed)
  figures = figures_of(played)
  if video is None:
    return figures
  try:
    return figures | {"video": str(record_episodes(env, played, video))}
  except OSError as error:  # The figures took minutes.
    say(f"cannot write {video}: {error}")
    return figures | {"video": None}
