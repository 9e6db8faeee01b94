"""Layout and files of videos, read back by imageio."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from apnpql_jax.training import video


def _frames(length: int, height: int, width: int, seed: int = 0) -> np.ndarray:
  """Returns blocks of flat color that change from frame to frame."""
  rng = np.random.default_rng(seed)
  blocks = rng.integers(0, 256, (length, height // 12, width // 12, 3), np.uint8)
  return blocks.repeat(12, axis=1).repeat(12, axis=2)


def test_tile_keeps_every_pixel_of_every_view():
  large, top, bottom = _frames(3, 96, 120), _frames(3, 24, 36, 1), _frames(3, 12, 24, 2)
  out = video.tile([large, top, bottom])
  assert out.shape == (3, 96, 120 + 2 + 72, 3) and out.dtype == np.uint8
  np.testing.assert_array_equal(out[:, :, :120], large)
  # Both 72 wide.
  for view, start, factor in ((top, 0, 2), (bottom, 50, 3)):
    for row, column in np.ndindex(factor * view.shape[1], factor * view.shape[2]):
      seen = out[:, start + row, 122 + column]
      np.testing.assert_array_equal(seen, view[:, row // factor, column // factor])
  assert not out[:, 48:50, 122:].any() and not out[:, :, 120:122].any()


def test_tile_grows_where_small_views_are_too_many():
  out = video.tile([_frames(1, 24, 24), _frames(1, 24, 24, 1), _frames(1, 24, 24, 2)])
  assert out.shape == (1, 50, 50, 3)


def test_border_leaves_the_inside_as_it_is():
  frames = _frames(4, 24, 36)
  before = frames.copy()
  out = video.add_border(frames, (1, 2, 3))
  np.testing.assert_array_equal(out[:, 4:-4, 4:-4], frames[:, 4:-4, 4:-4])
  for edge in (out[:, :4], out[:, -4:], out[:, :, :4], out[:, :, -4:]):
    assert (edge == (1, 2, 3)).all()
  np.testing.assert_array_equal(frames, before)


def test_written_video_shows_the_frames(tmp_path):
  frames = _frames(5, 36, 60)
  path = video.write_video(tmp_path / "episode.mp4", frames, fps=5)
  assert path == tmp_path / "episode.mp4"
  read = iio.imread(path, plugin="pyav")
  assert read.shape == (5, 48, 64, 3)
  # Middles of the blocks: the codec halves the resolution of color.
  error = read[:, 6:36:12, 6:60:12].astype(int) - frames[:, 6:36:12, 6:60:12]
  assert np.abs(error).mean() < 6
  assert read[:, 40:].max() < 40
  assert iio.immeta(path, plugin="pyav")["fps"] == 5


WRITE_WHILE_INTERRUPTED = """
import os, pathlib, signal, sys, threading, time
import numpy as np
from apnpql_jax.training import video

caught = []
signal.signal(signal.SIGINT, lambda number, _: caught.append(number))

def interrupt():
  while True:
    os.killpg(0, signal.SIGINT)
    time.sleep(0.01)

frames = np.random.default_rng(0).integers(0, 256, (50, 96, 96, 3), np.uint8)
threading.Thread(target=interrupt, daemon=True).start()
video.write_video(pathlib.Path(sys.argv[1]), frames, fps=5)
print(len(caught), flush=True)
os._exit(0)  # Not through finalization, which restores the default handler.
"""


def test_ctrl_c_does_not_cut_a_video_short(tmp_path):
  """A terminal sends SIGINT to the whole process group, helpers included."""
  path = tmp_path / "episode.mp4"
  command = [sys.executable, "-c", WRITE_WHILE_INTERRUPTED, str(path)]
  done = subprocess.run(
    command,
    cwd=Path(__file__).parents[2],
    start_new_session=True,
    check=True,
    capture_output=True,
    text=True,
  )
  assert int(done.stdout) > 0
  assert len(iio.imread(path, plugin="pyav")) == 50


def test_a_video_that_cannot_be_written_is_an_error(tmp_path):
  with pytest.raises(OSError, match="No such file"):
    video.write_video(tmp_path / "missing" / "x.mp4", _frames(2, 24, 36), fps=5)
  (tmp_path / "full.mp4").symlink_to("/dev/full")
  with pytest.raises(OSError, match="No space left"):
    video.write_video(tmp_path / "full.mp4", _frames(2, 24, 36), fps=5)


@pytest.mark.parametrize("name", ["20:05.mp4", "file:x.mp4", "http:x.gif", "%d #é.mp4"])
def test_a_name_is_not_taken_for_an_address(tmp_path, monkeypatch, name):
  monkeypatch.chdir(tmp_path)
  assert video.write_video(Path(name), _frames(2, 24, 36), fps=5) == Path(name)
  assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_path_that_ends_in_gif_makes_a_gif(tmp_path):
  frames = _frames(3, 24, 36)
  path = video.write_video(tmp_path / "episode.gif", frames, fps=5)
  assert path == tmp_path / "episode.gif"
  read = iio.imread(path)
  assert read.shape == frames.shape
  assert np.abs(read.astype(int) - frames).mean() < 6


@pytest.mark.parametrize(
  "frames",
  [
    np.zeros((2, 8, 8, 3), np.float32),
    np.zeros((8, 8, 3), np.uint8),
    np.zeros((2, 8, 8, 4), np.uint8),
    np.zeros((0, 8, 8, 3), np.uint8),
  ],
)
def test_arrays_that_are_not_videos_are_rejected(tmp_path, frames):
  with pytest.raises(ValueError, match="need u8|no frames"):
    video.write_video(tmp_path / "x.mp4", frames, fps=5)
  with pytest.raises(ValueError, match="need u8|no frames"):
    video.tile([frames])
  assert not list(tmp_path.iterdir())


def test_views_of_unequal_length_are_rejected():
  with pytest.raises(ValueError, match=r"length: \[2, 3\]"):
    video.tile([_frames(2, 24, 24), _frames(3, 24, 24)])


def test_noise_takes_less_at_its_rate_factor(tmp_path: Path):
  noise = np.random.default_rng(0).normal(128, 10, (8, 64, 96, 3))
  sizes = [
    video.write_video(
      tmp_path / f"{factor}.mp4", noise.astype(np.uint8), fps=5, rate_factor=factor
    )
    .stat()
    .st_size
    for factor in (video.CRISP, video.NOISY)
  ]
  assert sizes[1] < 0.3 * sizes[0]
