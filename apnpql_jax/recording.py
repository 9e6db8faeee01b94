"""Videos of episodes: a view of the whole robot next to both camera images."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from apnpql_jax.cameras import camera_renderer
from apnpql_jax.env import Env
from apnpql_jax.render.video import GREEN, RED, add_border, tile, write_video
from apnpql_jax.rollout import Episodes

VIEW_SIZE = (506, 674)
"""Height and width of the view of the robot in pixels; both camera images fit next to
it, the global one enlarged four times and the wrist one six times."""

HOLD = 4
"""Frames that show the last instant of an episode, framed in green or red."""


def record_episodes(env: Env, played: Episodes, path: Path) -> Path:
  """Writes the first episodes, one after another, as one video.

  Args:
    env: the environment in which they were played.
    played: the episodes.
    path: file to write; its folder is created.

  Returns:
    The path that was written, see ``write_video``.
  """
  frames = np.concatenate(film(env, played))
  path.parent.mkdir(parents=True, exist_ok=True)
  return write_video(path, frames, fps=1 / env.config.control_period_s)


def film(env: Env, played: Episodes) -> list[np.ndarray]:
  """Renders the first episodes.

  Args:
    env: the environment in which they were played.
    played: the episodes.

  Returns:
    u8[T, H, W, 3] for each episode. Its last instant is framed in green if the task
    was solved and in red otherwise.
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
    # Instants after the end are drawn too, so that one compiled program serves all.
    instants = int(played.length[episode]) + 1
    physics = jax.tree.map(lambda x: x[:, episode], played.states)  # noqa: B023
    frames = tile([np.asarray(view)[:instants] for view in draw(physics)])
    color = GREEN if played.success[episode] else RED
    last = add_border(frames[-1:], color).repeat(HOLD, axis=0)
    episodes.append(np.concatenate([frames[:-1], last]))
  return episodes
