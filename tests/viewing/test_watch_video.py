"""Videos and dashboards: what their pixels show."""

from __future__ import annotations

import imageio.v3 as iio
from matplotlib.colors import to_rgb
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.cli import main
from apnpql_jax.envs.cameras import in_hand
from apnpql_jax.viewing import shapes, watch_video
from apnpql_jax.viewing.actors import scripted
from apnpql_jax.viewing.dashboard import Dashboard
from apnpql_jax.viewing.frame import COLORS
from apnpql_jax.viewing.player import Player


def share_of(image: np.ndarray, color: str) -> float:
  """Returns the share of pixels near a color blended with a little white."""
  rgb = 255 * np.array(to_rgb(color))
  likely = 0.85 * rgb + 0.15 * 255
  near = [np.abs(image - x).max(-1) < 12 for x in (rgb, likely)]
  return float((near[0] | near[1]).mean())


@pytest.fixture(scope="module")
def frames(player):
  """Returns the frames of an episode."""
  return list(player.episode())


def test_the_strips_grow_in_the_colors_of_the_weights(frames):
  dashboard = Dashboard(epsilon=1.0, explained=True, scale=1)
  early, late = dashboard.draw(frames[:1]), dashboard.draw(frames)
  assert early.dtype == np.uint8 and early.shape == late.shape
  # What is drawn depends on the frames alone, not on what was drawn before.
  np.testing.assert_array_equal(dashboard.draw(frames[:1]), early)
  heaviest = COLORS[int(frames[-1].shares.argmax())]
  assert share_of(late, heaviest) > 2 * share_of(early, heaviest) > 0


def test_a_video_shows_every_instant(player, tmp_path):
  path, solved = watch_video.record(player, tmp_path / "watch.mp4", episodes=2)
  images = iio.imread(path, plugin="pyav")
  episode = len(list(player.episode())) - 1 + 8  # The last instant is held.
  assert images.shape == (2 * episode, *watch_video.SIZE, 3) and 0 <= solved <= 2
  assert (images[0] != images[episode]).any()


def test_the_projection_is_that_of_the_image(frames, player):
  """Where the ghost of the hand is drawn at its present pose, the image shows it."""
  scene = player.actor.env.task.scene
  painter = watch_video.Painter(scene, title="", epsilon=None)
  for frame in frames:
    hand = frame.poses.geom_xpos[scene.id("geom", "hand")]
    image = frame.images["wide"]
    spot = painter._project(hand[None], frame)[0] / watch_video._VIEW[::-1]
    column, row = (spot * image.shape[1::-1]).astype(int)
    assert image[row, column].max() < 80  # The hand is dark, the table is light.
    assert image[-1, 0].min() > 150


def test_a_ghost_in_the_present_pose_covers_the_hand(frames, player):
  scene, frame = player.actor.env.task.scene, frames[0]
  ghost = shapes.GhostHand(scene, scene.model.geom_size)
  tool = scene.tool_site
  origin, turn = frame.poses.site_xpos[tool], frame.poses.site_xmat[tool]
  centers = [part.mean(0) @ turn.T + origin for part in ghost.parts(frame.poses)]
  expected = frame.poses.geom_xpos[np.flatnonzero(in_hand(scene))]
  np.testing.assert_allclose(centers, expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX"])
def test_meshes_have_the_volume_of_their_shape(kind):
  import mujoco

  size = np.array([0.03, 0.05, 0.04])
  r, h = size[:2]
  volume = {
    "SPHERE": 4 / 3 * np.pi * r**3,
    "CAPSULE": 4 / 3 * np.pi * r**3 + 2 * np.pi * r**2 * h,
    "ELLIPSOID": 4 / 3 * np.pi * size.prod(),
    "CYLINDER": 2 * np.pi * r**2 * h,
    "BOX": 8 * size.prod(),
  }[kind]
  points = shapes.surface(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"), size)
  vertices, faces = shapes.mesh(points)
  a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
  # Signed volumes of tetrahedra add up only if all faces turn outward.
  found = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
  assert 0.93 * volume < found <= volume * (1 + 1e-6)


def test_random_actions_have_a_video_without_explanations(tmp_path):
  player = Player(scripted("random", testing.TINY.env), wide=(24, 32))
  frames = [player.begin(), player.step()]
  painter = watch_video.Painter(player.actor.env.task.scene, title="x", epsilon=None)
  image = painter.paint(frames, 2)
  assert image.shape == (*watch_video.SIZE, 3)
  assert share_of(image, COLORS[frames[1].stage]) > 0.003


@pytest.mark.parametrize(
  ("args", "words"),
  [
    ([], "needs a run folder, expert or random"),
    (["expert"], "--task goes with"),
    (["runs/x", "--task", "push_plate"], "--task goes with"),
    (["expert", "--task", "fly"], "unknown task 'fly'"),
    (["runs/none"], "is not a run folder"),
    (
      ["expert", "--task", "push_plate", "--video", "x.avi"],
      "must end in .mp4 or .gif",
    ),
    (["expert", "--task", "push_plate", "--port", "0"], "--port 0"),
    (["random", "--task", "push_plate", "--acting", "mean"], "need a run folder"),
    (["expert", "--task", "push_plate", "--seed", "-1"], "seed=-1"),
  ],
)
def test_bad_input_is_one_line(args, words, capsys):
  assert main.main(["watch", *args]) == 2
  assert words in capsys.readouterr().err


def test_the_command_writes_a_video(run_dir, tmp_path, capsys):
  path = str(tmp_path / "watch.mp4")
  assert main.main(["watch", str(run_dir), "--video", path]) == 0
  assert path in capsys.readouterr().out
  assert len(iio.imread(path, plugin="pyav")) > 5
  assert main.main(["watch", str(run_dir), "--video", path]) == 2
  assert "--overwrite" in capsys.readouterr().err
