"""Videos of episodes: the whole robot beside what both cameras see."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.cameras import camera_renderer
from apnpql_jax.env import Env, EnvState
from apnpql_jax.render.video import GREEN, RED, add_border, tile, write_video
from apnpql_jax.rollout import Policy
from apnpql_jax.types import Array

EPISODES = 4
VIEW_SIZE = (506, 674)
"""Height and width of the view of the robot in pixels; both cameras fit beside it, the
global one enlarged four times and that on the wrist six times."""

HOLD = 4
"""Frames for which the last instant of an episode stays, framed in green or red."""


def record_episodes(env: Env, policy: Policy, path: Path) -> None:
  """Plays held-out episodes one after another and writes them as one video.

  Args:
    env: the worlds.
    policy: what acts.
    path: of the file to write; its folder is made.
  """
  frames = np.concatenate(film(env, policy))
  path.parent.mkdir(parents=True, exist_ok=True)
  write_video(path, frames, fps=1 / env.config.control_period_s)


def film(env: Env, policy: Policy) -> list[np.ndarray]:
  """Plays held-out episodes; u8[T, H, W, 3] each, from the first to the last instant,
  which is framed in green if the task was solved and in red if not.

  Args:
    env: the worlds.
    policy: what acts.
  """
  rows = env.bank_split + jnp.arange(EPISODES)
  states, running, solved = jax.jit(lambda key: _play(env, policy, rows, key))(
    jax.random.key(0)
  )
  sizes = (
    ("wide", VIEW_SIZE),
    ("global", env.config.global_size),
    ("wrist", env.config.wrist_size),
  )
  cameras = [camera_renderer(env.config, env.task.scene, *size) for size in sizes]
  draw = jax.jit(lambda physics: [env.view(camera, physics) for camera in cameras])
  episodes = []
  for episode in range(EPISODES):
    steps = int(running[:, episode].sum())
    physics = jax.tree.map(lambda x: x[:, episode], states)  # noqa: B023
    frames = tile([np.asarray(view)[: steps + 1] for view in draw(physics)])
    color = GREEN if solved[:, episode].any() else RED
    last = add_border(frames[-1:], color).repeat(HOLD, axis=0)
    episodes.append(np.concatenate([frames[:-1], last]))
  return episodes


def _play(
  env: Env, policy: Policy, rows: Array, key: Array
) -> tuple[EnvState, Array, Array]:
  """Physics states, which episodes were still running, which were solved just now.

  All with leading axes [time, episodes].
  """

  def period(carry, key):
    state, running = carry
    policy_key, env_key = jax.random.split(key)
    moved = env.step(state, policy(state, policy_key)[0], env_key)
    running = running & ~state.timestep.last
    solved = running & moved.timestep.terminated
    return (moved, running), (state.physics, running, solved)

  start = (env.reset(rows), jnp.ones(EPISODES, bool))
  keys = jax.random.split(key, env.config.episode_steps + 1)
  return jax.lax.scan(period, start, keys)[1]
