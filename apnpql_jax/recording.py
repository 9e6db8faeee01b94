"""Videos of episodes: the whole robot beside what both cameras see."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from apnpql_jax.cameras import camera_renderer
from apnpql_jax.env import Env
from apnpql_jax.render.video import GREEN, RED, add_border, tile, write_video
from apnpql_jax.rollout import Episodes

VIEW_SIZE = (506, 674)
"""Height and width of the view of the robot in pixels; both cameras fit beside it, the
global one enlarged four times and that on the wrist six times."""

HOLD = 4
"""Frames for which the last instant of an episode stays, framed in green or red."""


def record_episodes(env: Env, played: Episodes, path: Path) -> Path:
  """Writes episodes one after another as one video.

  Args:
    env: the worlds in which they were played.
    played: the episodes, of which the first are filmed.
    path: of the file to write; its folder is made.

  Returns:
    the path that was written, see ``write_video``.
  """
  frames = np.concatenate(film(env, played))
  path.parent.mkdir(parents=True, exist_ok=True)
  return write_video(path, frames, fps=1 / env.config.control_period_s)


def film(env: Env, played: Episodes) -> list[np.ndarray]:
  """The first episodes; u8[T, H, W, 3] each, from the first to the last instant, which
  is framed in green if the task was solved and in red if not.

  Args:
    env: the worlds in which they were played.
    played: the episodes.
  """
  sizes = (
    ("wide", VIEW_SIZE),
    ("global", env.config.global_size),
    ("wrist", env.config.wrist_size),
  )
  cameras = [camera_renderer(env.config, env.task.scene, *size) for size in sizes]
  draw = jax.jit(lambda physics: [env.view(camera, physics) for camera in cameras])
  episodes = []
  for episode in range(played.states.time.shape[1]):
    # What comes later was never reached; drawn all the same, one program serves all.
    instants = int(played.length[episode]) + 1
    physics = jax.tree.map(lambda x: x[:, episode], played.states)  # noqa: B023
    frames = tile([np.asarray(view)[:instants] for view in draw(physics)])
    color = GREEN if played.success[episode] else RED
    last = add_border(frames[-1:], color).repeat(HOLD, axis=0)
    episodes.append(np.concatenate([frames[:-1], last]))
  return episodes
