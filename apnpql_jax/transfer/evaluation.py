"""Evaluation of a policy or the expert in worlds that differ from those of training.

The expert acts on privileged poses, so its success depends on the physics alone. Where
it fails, the condition is no evidence about a policy.
"""

from __future__ import annotations

from collections import Counter
import contextlib
import dataclasses
from pathlib import Path
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax import devices
from apnpql_jax.config.checks import ACTING
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.console import reporting
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import ConfigError, check_name
from apnpql_jax.runs import run_folder
from apnpql_jax.runs.success import success_figures
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import make_task
from apnpql_jax.training.diagnose import end_of
from apnpql_jax.training.evaluate import (
  check_count,
  check_video,
  held_out_batches,
  load_agent,
)
from apnpql_jax.transfer import identity, outcome_video
from apnpql_jax.transfer.condition import Condition, Renderer
from apnpql_jax.transfer.host_rollout import Act, Draw, EpisodeBatch, play
from apnpql_jax.types import Array

EXPERT_SUFFICES = 0.95
"""Success rate of the expert from which on a condition is evidence about a policy."""

_POSES = ("geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat")


def evaluate_run(
  run_dir: Path | str,
  condition: Condition,
  *,
  episodes: int = 200,
  seed: int = 0,
  step: int | None = None,
  acting: str | None = None,
  video: Path | str | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes under a condition with a checkpoint of a run.

  Args:
    run_dir: The run folder.
    condition: What the worlds consist of.
    episodes: Number of episodes.
    seed: Random seed of the episodes and of the policy.
    step: Step of the checkpoint; the newest if None.
    acting: Rule that chooses actions, see ``agents/acting.py``; that of the run's
      evaluations if None.
    video: File for a video of the first success and the first failure.

  Returns:
    What identifies the result, see ``identity.of_run``; the success rate with its
    Wilson interval; the mean length in control periods; failures by their last stage,
    as in ``diagnose``; the rows of the reset bank from which episodes failed, which
    are the same worlds under all conditions; and the time that it took, s.

  Raises:
    ConfigError: An argument is invalid, or a package or library is missing.
    FileError: Not a run folder, or no readable checkpoint.
  """
  began, video = time.monotonic(), None if video is None else check_video(video)
  condition.check()
  check_count(episodes, seed)
  if acting is not None:
    check_name("acting", acting, ACTING)
  run_dir = Path(run_dir)
  config = run_folder.open_run(run_dir).config
  if config.env.obs != "pixels":
    raise ConfigError(
      f"{run_dir} was trained with --obs {config.env.obs}; transfer needs pixels"
    )
  devices.start()
  # First, because a run that is training may remove the checkpoint meanwhile.
  task = make_task(config.env.task)
  agent, params, step = load_agent(run_dir, config, task, step=step)
  identified = identity.of_run(
    run_dir, config, step, condition, acting=acting, episodes=episodes, seed=seed
  )
  lstm_instants = config.agent.lstm_instants
  outside = condition.renderer != "rays"
  obs = "state" if outside else "pixels"  # Others draw the images.
  env = _make_env(
    config.env, condition, obs, lstm_instants=0 if outside else lstm_instants
  )
  rule = identified["acting"]
  choose = jax.jit(lambda p, seen, key: agent.act(p, seen, key, acting=rule)[0])

  def act(state: EnvState, seen: Any, key: Array) -> Array:
    del state
    return choose(params, seen, key)

  with contextlib.ExitStack() as stack:
    draw = _draw_of(env, condition, stack)
    lstm_instants = lstm_instants if draw else 0
    played = _play_all(
      env, condition, act, episodes, seed, draw=draw, lstm_instants=lstm_instants
    )
    filmed = _filmed(env, played, video, draw)
  return _summary(identified, played, began) | filmed


def evaluate_expert(
  env_config: EnvConfig,
  condition: Condition,
  *,
  episodes: int = 200,
  seed: int = 0,
  video: Path | str | None = None,
) -> dict[str, Any]:
  """Plays held-out episodes under a condition with the scripted expert.

  The arguments are those of ``evaluate_run``. The expert sees no images; a video shows
  those of the condition. ``sufficient`` in the result is whether the expert reaches
  ``EXPERT_SUFFICES``.
  """
  began, video = time.monotonic(), None if video is None else check_video(video)
  condition.check()
  check_count(episodes, seed)
  env = _make_env(env_config, condition, "state", lstm_instants=0)
  choose = jax.jit(env.expert_action)

  def act(state: EnvState, seen: Any, key: Array) -> Array:
    del seen, key
    return choose(state)

  played = _play_all(env, condition, act, episodes, seed)
  with contextlib.ExitStack() as stack:
    draw = _draw_of(env, condition, stack) if video else None
    filmed = _filmed(env, played, video, draw)
  identified = identity.of_expert(env_config, condition, episodes=episodes, seed=seed)
  found = _summary(identified, played, began)
  return found | filmed | {"sufficient": found["success_rate"] >= EXPERT_SUFFICES}


def make_draw(env: Env, renderer: Renderer) -> Draw:
  """Returns a function that draws all running worlds; others stay black."""
  sizes = env.config.global_size, env.config.wrist_size

  def draw(
    state: PhysicsState,
    rows: np.ndarray,
    running: np.ndarray,
    instants: int | np.ndarray,
  ) -> tuple[Array, Array]:
    kinematics, instants = env.poses(state), np.broadcast_to(instants, len(rows))
    poses = {name: np.asarray(getattr(kinematics, name)) for name in _POSES}
    fields = {name: np.asarray(x) for name, x in state.fields.items()}
    images = [np.zeros((len(rows), *size, 3), np.uint8) for size in sizes]
    for world in np.flatnonzero(running):
      views = renderer.draw(
        {name: x[world] for name, x in poses.items()},
        {name: x[world] for name, x in fields.items()},
        int(rows[world]),
        int(instants[world]),
      )
      for image, view in zip(images, views, strict=True):
        image[world] = view
    overview, wrist = map(jnp.asarray, images)
    return overview, wrist

  return draw


def _draw_of(
  env: Env, condition: Condition, stack: contextlib.ExitStack
) -> Draw | None:
  """Returns what draws the images; None if the environment draws them itself."""
  outside = condition.make_renderer(env)
  return make_draw(env, stack.enter_context(outside)) if outside else None


def _filmed(
  env: Env, played: list[EpisodeBatch], video: Path | None, draw: Draw | None
) -> dict[str, Any]:
  """Writes the video if asked for; returns its items of the result."""
  if video is None:
    return {}
  found: dict[str, Any] = {"video": None}
  with reporting(f"write {video}"):  # The episodes took minutes; keep their figures.
    found = outcome_video.record(env, played, video, draw=draw)
  return found


def _make_env(
  config: EnvConfig, condition: Condition, obs: str, *, lstm_instants: int
) -> Env:
  devices.start()
  # With Bullet, the environment only starts and observes the worlds.
  backend = "native" if condition.physics == "bullet" else condition.physics
  config = dataclasses.replace(
    config, backend=backend, randomize=condition.looks == "trained", obs=obs
  )
  return make_env(config, lstm_instants=lstm_instants)


def _play_all(
  env: Env, condition: Condition, act: Act, episodes: int, seed: int, **options: Any
) -> list[EpisodeBatch]:
  """Plays batches of episodes; the last one has no more than are asked for."""
  with contextlib.ExitStack() as stack:
    if worlds := condition.make_worlds(env):
      options["advance"] = stack.enter_context(worlds).advance
    played = [
      play(env, act, rows, key, **options)
      for rows, key in held_out_batches(env, episodes=episodes, seed=seed)
    ]
  excess = sum(len(batch.success) for batch in played) - episodes
  return [*played[:-1], played[-1].without_last(excess)]


def _summary(
  identified: dict[str, Any], played: list[EpisodeBatch], began: float
) -> dict[str, Any]:
  """Returns the result; ``began`` is a monotonic time, s."""
  success = np.concatenate([x.success for x in played])
  stages = [stage for x in played for stage in x.stages]
  failures = Counter(
    end_of(stages[i]) for i in np.flatnonzero(~success) if len(stages[i])
  )
  return {
    **identified,
    **success_figures(int(success.sum()), len(success)),
    "mean_length": float(np.concatenate([x.length for x in played]).mean()),
    "failures": dict(failures),
    "failed_rows": np.concatenate([x.rows for x in played])[~success].tolist(),
    "wall_s": time.monotonic() - began,
  }
