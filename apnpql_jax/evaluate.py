"""Held-out episodes: every world plays exactly one, from rows training never sees."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import math
from pathlib import Path
import sys
import time
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import checkpoint, leaves, memory, run_folder
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config import EnvConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.metrics import wilson_interval
from apnpql_jax.rollout import Policy, agent_policy, expert_policy
from apnpql_jax.types import Array

MAX_WORLDS = 64
"""Episodes played at once; more are played in turn."""


class Episodes(struct.PyTreeNode):
  """Outcome of one episode per world."""

  success: Array  # bool[worlds]
  length: Array  # i32[worlds]: control periods until success or time-out


Player = Callable[[Any, Array, Array], Episodes]
"""(parameters of the policy, bank rows i32[worlds], key) -> outcomes."""


def make_player(env: Env, make_policy: Callable[[Any], Policy]) -> Player:
  """A jitted function that plays one episode per row and stops when all are over."""

  @jax.jit
  def play(params: Any, rows: Array, key: Array) -> Episodes:
    policy = make_policy(params)

    def period(carry):
      state, outcome, running, key = carry
      key, policy_key, env_key = jax.random.split(key, 3)
      state = env.step(state, policy(state, policy_key)[0], env_key)
      running &= state.faults == 0  # What a world does after a fault is not counted.
      solved = running & state.timestep.terminated
      outcome = Episodes(outcome.success | solved, outcome.length + running)
      return state, outcome, running & ~state.timestep.last, key

    count = rows.shape[0]
    nothing = Episodes(jnp.zeros(count, bool), jnp.zeros(count, jnp.int32))
    start = (env.reset(rows), nothing, jnp.ones(count, bool), key)
    return jax.lax.while_loop(lambda carry: carry[2].any(), period, start)[1]

  return play


def play_held_out(
  env: Env, play: Player, params: Any, *, episodes: int, seed: int
) -> dict[str, Any]:
  """Plays ``episodes`` held-out episodes.

  The rows are a random order of all held-out ones, repeated if there are not enough.

  Returns:
    episodes, successes, success_rate, ci95 (Wilson), mean_length (control periods).
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
  successes = int(success.sum())
  return {
    "episodes": episodes,
    "successes": successes,
    "success_rate": successes / episodes,
    "ci95": wilson_interval(successes, episodes),
    "mean_length": float(length.mean()),
  }


def evaluate_run(
  run_dir: Path,
  *,
  episodes: int,
  seed: int,
  backend: str | None = None,
  step: int | None = None,
  greedy: bool = False,
) -> dict[str, Any]:
  """Plays held-out episodes with a checkpoint of a run.

  Args:
    run_dir: the run folder.
    episodes: how many.
    seed: of rows and actions.
    backend: physics engine; the run's own if None.
    step: of the checkpoint; the newest if None.
    greedy: the candidate of highest value or, of a parametric policy, the mean acts.

  Raises:
    ConfigError: not a run folder, or no readable checkpoint.
  """
  began = time.monotonic()
  config = run_folder.open_run(run_dir).config
  checkpoint.check(run_dir, step, config=config)
  env_config = dataclasses.replace(config.env, backend=backend or config.env.backend)
  env = make_env(env_config, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  example = jax.eval_shape(
    lambda rows: agent.init(jax.random.key(0), env.reset(rows).seen),
    jnp.zeros(1, jnp.int32),
  )
  memory.check_memory(leaves.nbytes(example), "the learner")
  found = checkpoint.restore(run_dir, step, {"learner": example}, config=config)
  for line in found.damaged:
    print(line, file=sys.stderr)
  learner = found.items["learner"]
  play = make_player(env, lambda params: agent_policy(agent, params, greedy=greedy))
  figures = play_held_out(
    env, play, learner.target_params, episodes=episodes, seed=seed
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
  env_config: EnvConfig, *, episodes: int, seed: int, noise: float
) -> dict[str, Any]:
  """Plays held-out episodes with the task's scripted expert."""
  began = time.monotonic()
  env = make_env(env_config)
  play = make_player(env, lambda _: expert_policy(env, noise=noise))
  figures = play_held_out(env, play, None, episodes=episodes, seed=seed)
  return {
    "task": env_config.task,
    "algorithm": "expert",
    "backend": env.physics.name,
    **figures,
    "checkpoint_step": None,
    "wall_s": time.monotonic() - began,
  }
