"""Evaluation on held-out episodes, whose reset states training never sees."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax import devices
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.agents.networks import Params
from apnpql_jax.atomic import check_utf8, check_writable
from apnpql_jax.config.checks import ACTING, MIN_BANK_ROWS, check_env
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.console import print_line, reporting
from apnpql_jax.envs.env import HELD_OUT_SHARE, Env, make_env, observation_shapes
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.primitives import reset_bank
from apnpql_jax.runs import abandoned_tasks, checkpoint_reader, leaves, run_folder
from apnpql_jax.runs.success import success_figures
from apnpql_jax.tasks import Task, make_task
from apnpql_jax.training.rollout import (
  Episodes,
  Player,
  agent_policy,
  expert_policy,
  make_player,
)
from apnpql_jax.training.video import record_episodes
from apnpql_jax.types import Array

MAX_WORLDS = 64
"""Episodes played in parallel; more are played in batches."""


def play_held_out(
  env: Env, play: Player, params: Any, *, episodes: int, seed: int
) -> Episodes:
  """Plays ``episodes`` held-out episodes.

  Their rows of the bank are random permutations of all held-out rows.

  Returns:
    The episodes, with the states of the first of them.
  """
  batches = held_out_batches(env, episodes=episodes, seed=seed)
  played = [play(params, rows, key) for rows, key in batches]
  success = np.concatenate([p.success for p in played])[:episodes]
  length = np.concatenate([p.length for p in played])[:episodes]
  return played[0].replace(success=success, length=length)


def held_out_batches(
  env: Env, *, episodes: int, seed: int
) -> list[tuple[Array, PRNGKeyArray]]:
  """Returns rows of the bank i32[worlds] and keys of batches of ``play_held_out``.

  The last batch is padded, so that all have one compiled size.
  """
  key = jax.random.key(seed)
  rng = np.random.default_rng(seed)
  orders = [rng.permutation(env.held_out) for _ in range(-(-episodes // env.held_out))]
  rows = env.bank_split + np.concatenate(orders)[:episodes]
  batches = math.ceil(episodes / MAX_WORLDS)
  size = math.ceil(episodes / batches)
  padded = np.resize(rows, batches * size).reshape(batches, size)
  return [
    (jnp.asarray(batch), jax.random.fold_in(key, i)) for i, batch in enumerate(padded)
  ]


def figures_of(played: Episodes) -> dict[str, Any]:
  """Returns counts, success rate, ci95 (Wilson) and mean length in control periods."""
  episodes = len(played.success)
  return {
    "episodes": episodes,
    **success_figures(int(played.success.sum()), episodes),
    "mean_length": float(played.length.mean()),
  }


def evaluate(
  run_dir: Path | str,
  *,
  episodes: int = 200,
  seed: int = 0,
  backend: str | None = None,
  step: int | None = None,
  acting: str | None = None,
  bank_seed: int = reset_bank.SEED,
  video: Path | str | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes with a checkpoint of a run.

  Args:
    run_dir: The run folder.
    episodes: Number of episodes.
    seed: Random seed of bank rows and actions.
    backend: Physics engine; that of the run if None.
    step: Step of the checkpoint; the newest if None.
    acting: Rule that chooses actions, see ``agents/acting.py``; that of the run's
      evaluations if None.
    bank_seed: Seed of the reset states. Evaluations during training used those of the
      default seed. Any other seed draws new states, as many as there are episodes.
    video: File for a video of the first episodes; failures to write are only printed.

  Returns:
    The success rate with its confidence interval, and what produced it.

  Raises:
    ConfigError: An argument is invalid; nothing was built.
    FileError: Not a run folder, or no readable checkpoint.
  """
  began = time.monotonic()
  video = _check(episodes, seed, video)
  if acting is not None:
    check_name("acting", acting, ACTING)
  config, env, agent, params, step = load_trained(
    run_dir, backend=backend, step=step, bank_seed=bank_seed, held_out=episodes
  )
  if episodes > env.held_out:
    print_line(
      f"{episodes:,} episodes repeat {env.held_out:,} held-out reset states; "
      "another bank seed draws as many as there are episodes"
    )
  acting = acting or config.eval_acting
  play = make_player(env, lambda params: agent_policy(agent, params, acting=acting))
  played = play_held_out(env, play, params, episodes=episodes, seed=seed)
  about = {"algorithm": config.agent.algorithm, "acting": acting}
  return _summary(env, played, about, step, began, video)


class Trained(NamedTuple):
  """A run that can act: ``agent.act(params, observation, key)``."""

  config: TrainConfig
  env: Env
  agent: Agent
  params: Params  # those that act
  step: int  # of the checkpoint


def load_trained(
  run_dir: Path | str,
  *,
  backend: str | None = None,
  step: int | None = None,
  bank_seed: int = reset_bank.SEED,
  held_out: int = 0,
) -> Trained:
  """Restores the weights of a run, and builds its worlds and agent.

  Args:
    run_dir: The run folder.
    backend: Physics engine; that of the run if None.
    step: Step of the checkpoint; the newest if None.
    bank_seed: Seed of the reset states, as in ``evaluate``.
    held_out: Fewest held-out rows of a bank whose seed is not the default.

  Raises:
    ConfigError: An argument is invalid; nothing was built.
    FileError: Not a run folder, or no readable checkpoint.
  """
  if not 0 <= bank_seed < 2**31:
    raise ConfigError(f"bank_seed={bank_seed} must be from 0 to 2**31 - 1")
  run_dir = Path(run_dir)
  config = run_folder.open_run(run_dir).config
  env_config = dataclasses.replace(config.env, backend=backend or config.env.backend)
  check_env(env_config)
  devices.start()
  # First, because a run that is training may remove the checkpoint meanwhile.
  loaded = load_agent(run_dir, config, make_task(config.env.task), step=step)
  if bank_seed != reset_bank.SEED:
    rows = max(MIN_BANK_ROWS, math.ceil(held_out / HELD_OUT_SHARE))
    env_config = dataclasses.replace(env_config, bank_rows=rows)
  lstm_instants = config.agent.lstm_instants
  env = make_env(env_config, lstm_instants=lstm_instants, bank_seed=bank_seed)
  return Trained(config, env, *loaded)


def load_agent(
  run_dir: Path, config: TrainConfig, task: Task, *, step: int | None
) -> tuple[Agent, Params, int]:
  """Restores the weights of a run, without building worlds.

  Returns:
    The agent, the parameters that act, and the step of the checkpoint.
  """
  agent = make_agent(config.agent)
  shapes = observation_shapes(
    config.env, task, lstm_instants=config.agent.lstm_instants
  )
  learner = jax.eval_shape(agent.init, jax.random.key(0), shapes)
  devices.check_memory(leaves.nbytes(learner.target_params), "the network")
  return agent, *load_params(run_dir, config, learner.target_params, step)


def load_params(
  run_dir: Path, config: TrainConfig, example: Params, step: int | None
) -> tuple[Params, int]:
  """Restores the weights that act from a checkpoint; returns them and the step.

  ``example`` are weights of the run or their shapes, ``step`` is as in ``evaluate``.

  Raises:
    FileError: There is no such checkpoint, or it cannot be read.
  """
  with abandoned_tasks.silenced():
    wanted = {"learner": {"target_params": example}}
    found = checkpoint_reader.restore(run_dir, step, wanted, config=config, partly=True)
  for line in found.damaged:
    print_line(line)
  return found.items["learner"]["target_params"], found.step


def evaluate_expert(
  env_config: EnvConfig,
  *,
  episodes: int,
  seed: int,
  noise: float,
  video: Path | str | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes with the task's scripted expert; see ``evaluate``.

  ``noise`` is the standard deviation of the noise on its joint velocities in rad/s.
  """
  began = time.monotonic()
  video = _check(episodes, seed, video)
  if not 0.0 <= noise < math.inf:
    raise ConfigError(f"noise={noise} must be a finite number of at least 0")
  env = make_env(env_config)
  play = make_player(env, lambda _: expert_policy(env, noise=noise))
  played = play_held_out(env, play, None, episodes=episodes, seed=seed)
  return _summary(env, played, {"algorithm": "expert"}, None, began, video)


def check_count(episodes: int, seed: int) -> None:
  """Raises ``ConfigError`` if no such episodes can be played."""
  if episodes < 1:
    raise ConfigError(f"episodes={episodes} must be at least 1")
  if not 0 <= seed < 2**31:
    raise ConfigError(f"seed={seed} must be from 0 to 2**31 - 1")


def _check(episodes: int, seed: int, video: Path | str | None) -> Path | None:
  """Checks the arguments of an evaluation; returns the path of its video."""
  check_count(episodes, seed)
  return None if video is None else check_video(video)


def check_video(video: Path | str) -> Path:
  """Returns the path of a video; raises ``UserError`` if it cannot be written."""
  path = Path(video)
  if path.suffix not in (".mp4", ".gif"):
    raise ConfigError(f"video {path} must end in .mp4 or .gif")
  check_utf8(path)
  check_writable(path.absolute().parent)
  if path.is_dir():
    raise ConfigError(f"video {path} is a folder")
  return path


def _summary(
  env: Env,
  played: Episodes,
  about: dict[str, Any],
  step: int | None,
  began: float,
  video: Path | None,
) -> dict[str, Any]:
  """Returns the figures and their context; writes the video if asked to."""
  summary: dict[str, Any] = {"task": env.config.task, "backend": env.physics.name}
  summary |= about | figures_of(played)
  if video is not None:
    summary["video"] = None
    with reporting(f"write {video}"):  # The episodes took minutes; keep their figures.
      summary["video"] = str(record_episodes(env, played, video))
  return summary | {"checkpoint_step": step, "wall_s": time.monotonic() - began}
