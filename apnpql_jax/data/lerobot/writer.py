"""Writing of datasets, one episode after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np

from apnpql_jax.atomic import check_writable, replacing
from apnpql_jax.data.lerobot import layout, statistics, tables
from apnpql_jax.data.lerobot.layout import COUNTERS, SUCCESS, Json
from apnpql_jax.data.lerobot.statistics import Stats
from apnpql_jax.data.lerobot.video import Video
from apnpql_jax.errors import FileError, one_line

if TYPE_CHECKING:
  import pyarrow as pa


class Writer:
  """A dataset that is being written.

  Each episode has files of its own, which get their names when it ends. Whatever stops
  the process, the dataset holds every episode that had ended before.
  """

  def __init__(
    self,
    folder: Path | str,
    *,
    fps: float,
    vectors: Mapping[str, Sequence[str]],
    images: Mapping[str, tuple[int, int]] | None = None,
    robot_type: str,
    about: Json | None = None,
    judged: bool = True,
  ):
    """Makes the folder and writes an empty dataset.

    Args:
      folder: Folder to make. It must be empty if it exists.
      fps: Frames per second.
      vectors: Column of numbers -> their names, such as "action".
      images: Column of images -> height and width, such as "observation.images.wrist".
      robot_type: Name of the robot.
      about: Anything else to record, such as devices, as JSON.
      judged: Whether each episode is given a success. Otherwise the dataset has no
        "next.success", because a learner would take a value of it for the truth.

    Raises:
      ConfigError: pyarrow is missing.
      FileError: The folder is not empty, or cannot be written.
    """
    layout.check_available()
    self.folder = Path(folder)
    self._fps, self._robot_type = float(fps), robot_type
    self._vectors = {name: list(names) for name, names in vectors.items()}
    self._images = dict(images or {})
    self._judged = judged
    self._features = layout.features(
      self._vectors, self._images, self._fps, judged=judged
    )
    self._tasks: list[str] = []
    self._stats: dict[str, Stats] = {}
    self._episodes = self._frames = 0
    self._rows: dict[str, list[np.ndarray]] = {}
    self._videos: dict[str, Video] = {}
    check_writable(self.folder)
    if self.folder.exists() and (
      not self.folder.is_dir() or any(self.folder.iterdir())
    ):
      raise FileError(f"{str(self.folder)!r} exists; name a folder to make")
    try:
      (self.folder / "meta").mkdir(parents=True, exist_ok=True)
      if about is not None:
        self._write_json(layout.ABOUT, about)
      self._write_info()
    except (OSError, av.FFmpegError) as error:
      raise self._failed(error) from None

  def __enter__(self) -> Writer:
    return self

  def __exit__(self, *error: object) -> None:
    self.close()

  def add(self, frame: Mapping[str, Any]) -> None:
    """Adds a frame to the episode.

    Args:
      frame: A value for each column of numbers, and u8[H, W, 3] for each of images.

    Raises:
      FileError: A video cannot be written.
      ValueError: A column is missing or unknown, or has another shape.
    """
    if frame.keys() != self._vectors.keys() | self._images.keys():
      wanted = sorted(self._vectors.keys() | self._images.keys())
      raise ValueError(f"a frame has {sorted(frame)}, not {wanted}")
    rows = {name: np.asarray(frame[name], np.float32) for name in self._vectors}
    for name, row in rows.items():
      if row.shape != (len(self._vectors[name]),):
        raise ValueError(f"{name} has shape {row.shape}, not {self._vectors[name]}")
    for name, size in self._images.items():
      image = np.asarray(frame[name])
      if image.shape != (*size, 3) or image.dtype != np.uint8:
        raise ValueError(f"{name} is {image.dtype}{list(image.shape)}, not u8{size}")
    try:
      for name in self._images:
        if name not in self._videos:
          self._videos[name] = Video(self._part(name), self._images[name], self._fps)
        self._videos[name].add(np.asarray(frame[name]))
    except (OSError, av.FFmpegError) as error:
      raise self._failed(error) from None
    for name, row in rows.items():
      self._rows.setdefault(name, []).append(row)

  def end_episode(self, task: str, success: bool | None = None) -> None:
    """Writes the episode.

    Args:
      task: What the robot was to do, in words.
      success: Whether it was done at the last frame; None if nobody has judged it.

    Raises:
      FileError: It cannot be written.
      ValueError: The episode has no frames, or ``success`` is given although ``judged``
        is False, or is missing although it is True.
    """
    if not self._rows:
      raise ValueError("an episode needs a frame")
    if (success is not None) != self._judged:
      raise ValueError(f"success is {success} in a dataset with judged={self._judged}")
    if task not in self._tasks:
      self._tasks.append(task)
    columns = self._columns(task, success)
    count = len(columns["index"])
    stats = {name: statistics.of_numbers(values) for name, values in columns.items()}
    where = layout.place(self._episodes)
    row: Json = {
      "episode_index": self._episodes,
      "tasks": [task],
      "length": count,
      "dataset_from_index": self._frames,
      "dataset_to_index": self._frames + count,
    }
    for kind in ("data", "meta/episodes"):
      row |= {f"{kind}/{name}": index for name, index in where.items()}
    try:
      for name, video in self._videos.items():
        stats[name] = video.pixels.stats()
        path = self.folder / layout.VIDEO.format(video_key=name, **where)
        path.parent.mkdir(parents=True, exist_ok=True)
        video.finish(path)
        row |= {f"videos/{name}/{key}": index for key, index in where.items()}
        row[f"videos/{name}/from_timestamp"] = 0.0
        row[f"videos/{name}/to_timestamp"] = count / self._fps
      for name, found in stats.items():
        row |= {f"stats/{name}/{key}": x.tolist() for key, x in found.items()}
        earlier = self._stats.get(name)
        self._stats[name] = statistics.combined(earlier, found) if earlier else found
      # A reader believes the last of these files, so it comes last.
      self._write_table(layout.DATA.format(**where), tables.of_columns(columns))
      self._write_table(layout.TASKS, tables.of_tasks(self._tasks))
      self._write_table(layout.EPISODES.format(**where), tables.of_row(row))
      self._write_json(
        layout.STATS,
        {
          name: {key: x.tolist() for key, x in found.items()}
          for name, found in self._stats.items()
        },
      )
      self._episodes, self._frames = self._episodes + 1, self._frames + count
      self._write_info()
    except (OSError, av.FFmpegError) as error:
      raise self._failed(error) from None
    self._rows, self._videos = {}, {}

  def discard_episode(self) -> None:
    """Forgets the frames since the last episode."""
    for video in self._videos.values():
      video.discard()
    self._rows, self._videos = {}, {}

  def close(self) -> None:
    """Ends the dataset; frames since the last episode are lost."""
    self.discard_episode()

  def _columns(self, task: str, success: bool | None) -> dict[str, np.ndarray]:
    """Returns the columns of the episode, [n, k] each."""
    columns = {name: np.stack(rows) for name, rows in self._rows.items()}
    count = len(next(iter(columns.values())))
    numbers = np.arange(count)
    counters = {
      "timestamp": numbers / self._fps,
      "frame_index": numbers,
      "episode_index": np.full(count, self._episodes),
      "index": self._frames + numbers,
      "task_index": np.full(count, self._tasks.index(task)),
    }
    if success is not None:
      columns[SUCCESS] = ((numbers == count - 1) & success)[:, None]
    for name, kind in COUNTERS.items():
      columns[name] = counters[name].astype(kind)[:, None]
    return columns

  def _write_info(self) -> None:
    self._write_json(
      layout.INFO,
      layout.info(
        self._features,
        fps=self._fps,
        robot_type=self._robot_type,
        episodes=self._episodes,
        frames=self._frames,
        tasks=len(self._tasks),
      ),
    )

  def _write_table(self, name: str, table: pa.Table) -> None:
    import pyarrow.parquet as pq

    path = self.folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
      pq.write_table(table, part, compression="snappy")

  def _write_json(self, name: str, value: Json) -> None:
    with replacing(self.folder / name) as part:
      part.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")

  def _part(self, name: str) -> Path:
    """Returns the file of a video that is being written."""
    return self.folder / f"{name.removeprefix(layout.IMAGES)}.part.mp4"

  def _failed(self, error: Exception) -> FileError:
    return FileError(f"cannot write {str(self.folder)!r}: {one_line(error)}")
