"""Videos of episodes: a view of the robot next to the images of both cameras."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import imageio.v3 as iio
import jax
import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.envs.cameras import VIEW_SIZE, camera_renderer
from apnpql_jax.envs.env import Env
from apnpql_jax.training.rollout import Episodes

GREEN = (40, 200, 80)
RED = (220, 60, 50)

_GAP = 2  # black pixels between views
_BORDER = 4  # width of a border in pixels
_MACROBLOCK = 16  # video codecs need sides that are multiples of this

CRISP, NOISY = 10, 28
"""Rate factors of MP4: flat colors and hard edges need one below x264's default of 23,
and the noise of unseen looks would take megabytes."""

HOLD = 4
"""Frames for which the last instant of an episode stays, framed in green or red."""


def record_episodes(env: Env, played: Episodes, path: Path) -> Path:
  """Writes the first episodes as one video; creates the folder of ``path``.

  Returns:
    The path that was written, see ``write_video``.
  """
  frames = np.concatenate(render_episodes(env, played))
  path.parent.mkdir(parents=True, exist_ok=True)
  return write_video(path, frames, fps=1 / env.config.control_period_s)


def render_episodes(env: Env, played: Episodes) -> list[np.ndarray]:
  """Renders the first episodes, u8[T, H, W, 3] each.

  The last instant gets a green border if the task was solved, else a red one.
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
    # Draw the unused instants after the end too, so that one program suffices.
    instants = int(played.length[episode]) + 1
    physics = jax.tree.map(lambda x: x[:, episode], played.states)  # noqa: B023
    frames = tile([np.asarray(view)[:instants] for view in draw(physics)])
    color = GREEN if played.success[episode] else RED
    last = add_border(frames[-1:], color).repeat(HOLD, axis=0)
    episodes.append(np.concatenate([frames[:-1], last]))
  return episodes


def tile(views: Sequence[np.ndarray]) -> np.ndarray:
  """Puts a large view on the left and the others in a column to its right.

  The others are enlarged by whole factors, nearest neighbor, to about the same width,
  as far as the height of the large view allows; the rest is black.

  Args:
    views: u8[T, H_i, W_i, 3], the large view first, then at least one other.

  Returns:
    u8[T, H, W, 3].

  Raises:
    ValueError: The views are not videos of equal length.
  """
  for view in views:
    _check(view)
    if len(view) != len(views[0]):
      raise ValueError(f"views differ in length: {[len(v) for v in views]}")
  large, others = views[0], views[1:]
  frames, height = large.shape[:2]
  for factor in range(max(1, height // others[0].shape[1]), 0, -1):
    width = factor * others[0].shape[2]
    enlarged = [_enlarge(v, max(1, round(width / v.shape[2]))) for v in others]
    needed = sum(v.shape[1] for v in enlarged) + _GAP * (len(others) - 1)
    if needed <= height:
      break
  width = max(v.shape[2] for v in enlarged)
  left = large.shape[2] + _GAP
  out = np.zeros((frames, max(height, needed), left + width, 3), np.uint8)
  out[:, :height, : large.shape[2]] = large
  top = 0
  for view in enlarged:
    out[:, top : top + view.shape[1], left : left + view.shape[2]] = view
    top += view.shape[1] + _GAP
  return out


def _enlarge(frames: np.ndarray, factor: int) -> np.ndarray:
  return frames.repeat(factor, axis=1).repeat(factor, axis=2)


def add_border(frames: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
  """Returns a copy of u8[T, H, W, 3] with a border of an RGB color inside."""
  _check(frames)
  out = np.empty_like(frames)
  out[:] = color
  inner = np.s_[:, _BORDER:-_BORDER, _BORDER:-_BORDER]
  out[inner] = frames[inner]
  return out


def write_video(
  path: Path,
  frames: np.ndarray | Iterator[np.ndarray],
  *,
  fps: float,
  rate_factor: int = CRISP,
) -> Path:
  """Writes frames as MP4, or as GIF if the path ends in ".gif".

  Args:
    path: File to write; any suffix other than ".gif" becomes ".mp4".
    frames: u8[T, H, W, 3], or an iterator over u8[H, W, 3], of which an MP4 holds one
      at a time in memory; padded with black to what the codec needs.
    fps: Frames per second of playback.
    rate_factor: Quality of an MP4, from 0 (lossless) to 51.

  Returns:
    The path that was written.

  Raises:
    ValueError: The frames are not u8[T, H, W, 3], or there are none.
    OSError: The file cannot be written.
  """
  if isinstance(frames, np.ndarray):
    _check(frames)
  if path.suffix == ".gif":
    every = frames if isinstance(frames, np.ndarray) else np.stack([*frames])
    _check(every)
    with replacing(path) as part:
      iio.imwrite(part, every, duration=1000.0 / fps, loop=0)
    return path
  path = path.with_suffix(".mp4")
  with replacing(path) as part:
    _encode(part, frames, fps, rate_factor)
  return path


def _encode(
  path: Path, frames: Iterable[np.ndarray], fps: float, rate_factor: int
) -> None:
  # imageio's PyAV plugin cannot set the rate factor.
  with av.open(str(path), "w", format="mp4") as file:
    stream = file.add_stream("libx264", Fraction(fps).limit_denominator(1000))
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": str(rate_factor)}
    for number, frame in enumerate(frames):
      _check(frame[None])
      padding = [(0, -side % _MACROBLOCK) for side in frame.shape[:2]]
      frame = np.pad(frame, (*padding, (0, 0)))
      if not number:
        stream.height, stream.width = frame.shape[:2]
      file.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
    file.mux(stream.encode())


def _check(frames: np.ndarray) -> None:
  if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
    raise ValueError(f"need u8[T, H, W, 3], got {frames.dtype}{list(frames.shape)}")
  if not frames.size:
    raise ValueError(f"no frames: {list(frames.shape)}")
