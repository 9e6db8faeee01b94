"""Files and features of a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from apnpql_jax.errors import ConfigError

Json = dict[str, Any]

VERSION = "v3.0"
FILES_PER_CHUNK = 1000

_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA = f"data/{_PLACE}.parquet"
VIDEO = f"videos/{{video_key}}/{_PLACE}.mp4"
EPISODES = f"meta/episodes/{_PLACE}.parquet"
ALL_EPISODES = "meta/episodes/chunk-???/file-???.parquet"
"""Pattern of ``EPISODES``, which leaves out a file that is being written."""

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
ABOUT = "meta/apnpql.json"
"""Whatever the writer of a dataset adds, which LeRobot does not read."""

STATE = "observation.state"
ACTION = "action"
IMAGES = "observation.images."
"""Prefix of the cameras."""

ENVIRONMENT = "observation.environment_state"
SUCCESS = "next.success"
TIMES = "times"
"""Column of a log: measured times since the beginning of the episode, s. With this
name, it is no input of LeRobot's policies, which take all of "observation"."""

COUNTERS = {
  "timestamp": "float32",
  "frame_index": "int64",
  "episode_index": "int64",
  "index": "int64",
  "task_index": "int64",
}
"""Columns that every dataset has -> their type."""


def check_available() -> None:
  """Raises ``ConfigError`` if the package that reads and writes parquet is missing."""
  try:
    import pyarrow.parquet  # noqa: F401
  except ImportError:
    raise ConfigError(
      "datasets of LeRobot need pyarrow: pip install 'apnpql-jax[lerobot]'"
    ) from None


def is_dataset(path: Path) -> bool:
  """Returns whether a folder claims to be a dataset."""
  return (path / INFO).is_file()


def place(episode: int) -> dict[str, int]:
  """Returns the chunk and the file of an episode, which has files of its own."""
  chunk, file = divmod(episode, FILES_PER_CHUNK)
  return {"chunk_index": chunk, "file_index": file}


def features(
  vectors: Mapping[str, Sequence[str]],
  images: Mapping[str, tuple[int, int]],
  fps: float,
  *,
  judged: bool = True,
) -> dict[str, Json]:
  """Returns the features of ``info.json``.

  Args:
    vectors: Column -> names of its numbers.
    images: Column -> height and width.
    fps: Frames per second.
    judged: Whether it is known if the task was done.
  """
  found: dict[str, Json] = {
    name: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    for name, names in vectors.items()
  }
  for name, (height, width) in images.items():
    found[name] = {
      "dtype": "video",
      "shape": [height, width, 3],
      "names": ["height", "width", "channels"],
      "info": {
        "video.height": height,
        "video.width": width,
        "video.codec": "h264",
        "video.pix_fmt": "yuv444p",
        "video.is_depth_map": False,
        "video.fps": fps,
        "video.channels": 3,
        "has_audio": False,
      },
    }
  if judged:
    found[SUCCESS] = {"dtype": "bool", "shape": [1], "names": None}
  for name, kind in COUNTERS.items():
    found[name] = {"dtype": kind, "shape": [1], "names": None}
  return found


def info(
  described: dict[str, Json],
  *,
  fps: float,
  robot_type: str,
  episodes: int,
  frames: int,
  tasks: int,
) -> Json:
  """Returns the content of ``info.json``."""
  videos = any(about["dtype"] == "video" for about in described.values())
  return {
    "codebase_version": VERSION,
    "robot_type": robot_type,
    "total_episodes": episodes,
    "total_frames": frames,
    "total_tasks": tasks,
    "chunks_size": FILES_PER_CHUNK,
    "data_files_size_in_mb": 100,
    "video_files_size_in_mb": 200,
    "fps": fps,
    "splits": {"train": f"0:{episodes}"} if episodes else {},
    "data_path": DATA,
    "video_path": VIDEO if videos else None,
    "features": described,
  }
