"""Video of the first success and the first failure under a condition."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.envs.cameras import VIEW_SIZE, camera_renderer, make_cameras
from apnpql_jax.envs.env import Env
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.training.video import (
  GREEN,
  HOLD,
  NOISY,
  RED,
  add_border,
  tile,
  write_video,
)
from apnpql_jax.transfer.host_rollout import Draw, EpisodeBatch


def record(
  env: Env, played: Sequence[EpisodeBatch], path: Path, *, draw: Draw | None
) -> dict[str, Any]:
  """Writes the first success and the first failure, one after the other.

  The large view comes from the ray caster, the others from the condition's renderer.

  Args:
    env: The worlds.
    played: Episodes.
    path: The file; its folder is created.
    draw: Draws the images of the condition; the ray caster if None.

  Returns:
    ``video``: the written path; ``video_episodes``: the numbers of the two episodes,
    None where there is none.
  """
  chosen = {True: first(played, success=True), False: first(played, success=False)}
  clips = [
    _clip(env, *_find(played, number), draw, color=GREEN if success else RED)
    for success, number in chosen.items()
    if number is not None
  ]
  path.parent.mkdir(parents=True, exist_ok=True)
  fps, frames = 1 / env.config.control_period_s, np.concatenate(clips)
  written = write_video(path, frames, fps=fps, rate_factor=NOISY)
  numbers = {"success": chosen[True], "failure": chosen[False]}
  return {"video": str(written), "video_episodes": numbers}


def first(played: Sequence[EpisodeBatch], *, success: bool) -> int | None:
  """Returns the number of the first episode that succeeded or failed, if any."""
  found = np.flatnonzero(np.concatenate([x.success for x in played]) == success)
  return int(found[0]) if len(found) else None


def _find(played: Sequence[EpisodeBatch], number: int) -> tuple[EpisodeBatch, int]:
  for batch in played:
    if number < len(batch.success):
      return batch, number
    number -= len(batch.success)
  raise IndexError(number)


def _clip(
  env: Env,
  batch: EpisodeBatch,
  world: int,
  draw: Draw | None,
  color: tuple[int, int, int],
) -> np.ndarray:
  """Renders an episode, u8[T, H, W, 3]."""
  count = int(batch.length[world]) + 1
  # Always as many instants, so that one program draws every clip.
  instants = np.arange(env.config.episode_steps + 1).clip(0, count - 1)
  start: PhysicsState = jax.tree.map(
    lambda x: jnp.repeat(x[world][None], len(instants), axis=0), batch.start
  )
  states = start.replace(qpos=jnp.asarray(batch.qpos[instants, world]))
  config, scene = env.config, env.task.scene
  cameras = [camera_renderer(config, scene, "wide", VIEW_SIZE)]
  if draw is None:
    cameras += make_cameras(config, scene)
  views: list[Any] = list(jax.jit(lambda s: [env.view(c, s) for c in cameras])(states))
  if draw is not None:
    rows = np.full(len(instants), batch.rows[world])
    views += draw(states, rows, np.arange(len(instants)) < count, instants)
  frames = tile([np.asarray(view)[:count] for view in views])
  last = add_border(frames[-1:], color).repeat(HOLD, axis=0)
  return np.concatenate([frames[:-1], last])
