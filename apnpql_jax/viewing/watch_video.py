"""Videos of watched episodes: the scene, both cameras, and the plots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from apnpql_jax.sim.scene import Scene
from apnpql_jax.training import video
from apnpql_jax.viewing import strips
from apnpql_jax.viewing.frame import COLORS, Frame
from apnpql_jax.viewing.panels import InstantPanel, StripsPanel, place_cameras
from apnpql_jax.viewing.player import Player
from apnpql_jax.viewing.shapes import GhostHand
from apnpql_jax.viewing.sheet import Sheet, draw_picture

SIZE = (720, 1280)
"""Height and width of a video in pixels."""

WIDE = (738, 1080)
"""Height and width of the image of the camera ``wide``, for the closest view."""

_VIEW = (492, 720)
"""Height and width at which the scene, or a part of it, is shown, in pixels."""

_MARGIN = 55
"""Pixels around all that moves in the view."""

_SOLVED, _FAILED = "#2b8a3e", "#c92a2a"
_TOP = 36
"""Height of the headline in pixels."""


class Painter:
  """Painter of the images of a video, one per frame of an episode."""

  def __init__(self, scene: Scene, *, title: str, epsilon: float | None):
    """Prepares the sheet; ``title`` names the actor, ``epsilon`` limits its KL."""
    self._scene, self._title = scene, title
    self._hand = GhostHand(scene, scene.model.geom_size)
    height, width = SIZE
    self._sheet = sheet = Sheet(width, height)
    self._pictures: dict[str, Axes] = {}
    left, top = _VIEW[1] + 24, _TOP + _VIEW[0] + 6
    box = (left, _TOP, width - left - 18, height - _TOP - 8)
    self._cameras = (12, top, 364, height - top - 12)
    self._strips = StripsPanel(sheet, box, epsilon=epsilon)
    self._instant = InstantPanel(sheet, (392, top, _VIEW[1] - 396, height - top - 4))

  def paint(self, frames: Sequence[Frame], count: int) -> np.ndarray:
    """Returns the image u8[*SIZE, 3] of frame ``count``, from 1, of an episode."""
    frame, span_s = frames[count - 1], frames[-1].time_s + frames[-1].period_s
    part = self._part(frames)

    def prepare() -> None:
      wide = self._sheet.picture(0, _TOP, _VIEW[1], _VIEW[0])
      wide.set(**part)
      self._pictures = {"wide": wide} | place_cameras(self._sheet, self._cameras, frame)
      if frame.explanation is not None:
        self._instant.prepare()
      self._strips.prepare(frames, span_s)

    def draw() -> Iterator[Artist]:
      for name, axis in self._pictures.items():
        whole = (0, _VIEW[1], _VIEW[0], 0) if name == "wide" else None
        yield draw_picture(axis, frame.images[name], whole)
      yield from self._overlay(self._pictures["wide"], frame)
      yield from self._headline(frame)
      if frame.explanation is not None:
        yield from self._instant.draw(frame)
      yield from self._strips.draw(frames[:count])

    key = (*part.values(), self._strips.key(frames, span_s))
    return self._sheet.image(key, prepare, draw)

  def _part(self, frames: Sequence[Frame]) -> dict[str, tuple[float, float]]:
    """Returns limits of the view around the robot, the objects and the tool paths."""
    moving = np.flatnonzero(self._scene.model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    points = [
      self._project(
        np.concatenate(
          [f.poses.geom_xpos[moving], *(path.positions for path in f.tool_paths)]
        ),
        f,
      )
      for f in frames
    ]
    size = np.array(_VIEW[::-1])
    low, high = (f(np.concatenate(points), axis=0) for f in (np.min, np.max))
    low, high = low - _MARGIN, high + _MARGIN
    zoom = np.clip((size / (high - low)).min(), 1.0, WIDE[0] / _VIEW[0])
    left, top = np.clip((low + high - size / zoom) / 2, 0, size * (1 - 1 / zoom))
    right, bottom = np.array([left, top]) + size / zoom
    return {"xlim": (left, right), "ylim": (bottom, top)}

  def _headline(self, frame: Frame) -> Iterator[Artist]:
    text = f"{self._scene.name}   {self._title}"
    if frame.checkpoint is not None:
      text += f"   step {frame.checkpoint:,}"
    text += f"   episode {frame.episode}"
    place: dict[str, Any] = {"y": 1 - 18 / SIZE[0], "va": "center", "fontsize": 11}
    yield self._sheet.figure.text(0.01, s=text, color=strips.INK, **place)
    if frame.last:
      text, color = ("solved", _SOLVED) if frame.solved else ("not solved", _FAILED)
      at = (_VIEW[1] - 12) / SIZE[1]
      weight: Any = {"fontweight": "bold", "ha": "right"}
      yield self._sheet.figure.text(at, s=text, color=color, **place | weight)

  def _overlay(self, axis: Axes, frame: Frame) -> Iterator[Artist]:
    """Draws the tool paths and ghost hands of the primitives over the scene."""
    parts = self._hand.parts(frame.poses)
    likely = int(np.argmax(frame.shares))
    for k in np.argsort(frame.shares):  # The likeliest is on top.
      path, share, color = frame.tool_paths[k], float(frame.shares[k]), COLORS[k]
      strength = 0.25 + 0.75 * share
      way = self._project(path.positions, frame)
      ghost = [self._project(x @ path.mat.T + path.positions[-1], frame) for x in parts]
      yield axis.add_patch(
        PathPatch(
          _union(ghost),
          facecolor=color,
          edgecolor="none",
          alpha=0.2 + 0.45 * share,
        )
      )
      yield from axis.plot(
        *way.T, color="white", linewidth=2.5 + 3 * share, alpha=0.5 * strength
      )
      yield from axis.plot(
        *way.T, color=color, linewidth=1 + 2.5 * share, alpha=strength
      )
      yield from axis.plot(
        *way[-1], "o", color=color, markersize=4 + 3 * share, alpha=strength
      )
    yield axis.text(
      0.015,
      0.03,
      frame.headline,
      transform=axis.transAxes,
      fontsize=13,
      fontweight="bold",
      color="white",
      bbox={"facecolor": COLORS[likely], "edgecolor": "none", "boxstyle": "round"},
    )

  def _project(self, points: np.ndarray, frame: Frame) -> np.ndarray:
    """Returns the pixels (x, y) of points in the world, f64[n, 2]."""
    camera = self._scene.id("camera", "wide")
    poses = frame.poses
    fovy = poses.fields.get("cam_fovy", self._scene.model.cam_fovy)[camera]
    x, y, z = ((points - poses.cam_xpos[camera]) @ poses.cam_xmat[camera]).T
    focal = 0.5 * _VIEW[0] / np.tan(np.radians(fovy) / 2)
    depth = np.maximum(-z, 0.01)  # m; what is behind the camera is out of the image.
    return np.c_[_VIEW[1] / 2 + focal * x / depth, _VIEW[0] / 2 - focal * y / depth]


def record(player: Player, path: Path, *, episodes: int) -> tuple[Path, int]:
  """Plays episodes and writes them as a video.

  Args:
    player: Plays the episodes; it draws the camera ``wide`` in the size ``WIDE``.
    path: File to write, see ``video.write_video``.
    episodes: Number of episodes.

  Returns:
    The path that was written, and the number of solved episodes.
  """
  actor, solved = player.actor, 0
  env = actor.env
  painter = Painter(env.task.scene, title=actor.title, epsilon=actor.epsilon)

  def images() -> Iterator[np.ndarray]:
    nonlocal solved
    for _ in range(episodes):
      frames = list(player.episode())
      solved += frames[-1].solved
      for count in range(1, len(frames) + 1):
        image = painter.paint(frames, count)
        yield from [image] * (1 if count < len(frames) else 2 * video.HOLD)

  fps = 1 / env.config.control_period_s
  return video.write_video(path, images(), fps=fps), solved


def _union(parts: Sequence[np.ndarray]) -> Outline:
  """Returns the outline of the hulls of points in the plane, f64[n, 2] each.

  All hulls turn the same way, so that overlaps are filled once.
  """
  hulls = [points[ConvexHull(points).vertices] for points in parts]
  return Outline.make_compound_path(*(Outline(hull, closed=False) for hull in hulls))
