"""Reading of datasets, with one-line errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import av
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.data.lerobot import layout
from apnpql_jax.data.lerobot.layout import ACTION, COUNTERS, STATE, SUCCESS, Json
from apnpql_jax.errors import FileError, UserError, one_line


@dataclasses.dataclass(frozen=True)
class Episode:
  """Recorded data of one episode, in n frames."""

  task: str
  """What the robot was to do, in words."""

  time: np.ndarray
  """Time since the first frame f64[n], s."""

  period: float
  """Time between frames, s."""

  columns: Mapping[str, np.ndarray]
  """Columns of numbers f64[n, k], by name."""

  success: bool | None
  """Whether the task was done at the last frame; None if the dataset has no label."""

  videos: Mapping[str, tuple[Path, float]]
  """Column of images -> its file, and the time at which the episode begins there."""

  @property
  def joints(self) -> np.ndarray:
    """Joint angles f64[n, 6], rad."""
    return self.columns[STATE][:, :6]

  @property
  def gripper(self) -> np.ndarray:
    """Angle of the driven finger f64[n], rad."""
    return self.columns[STATE][:, 6]

  @property
  def actions(self) -> np.ndarray:
    """Desired joint velocities (rad/s) and gripper command f64[n, 7]."""
    return self.columns[ACTION]

  def images(self, name: str) -> Iterator[np.ndarray]:
    """Yields the images u8[H, W, 3] of a column.

    Raises:
      FileError: The video cannot be read.
    """
    path, begin = self.videos[name]
    left = len(self.time)
    try:
      with av.open(str(path)) as file:
        for frame in file.decode(video=0):
          if frame.time > begin - 0.5 * self.period:
            left -= 1
            yield frame.to_ndarray(format="rgb24")
          if not left:
            return
    except (OSError, av.FFmpegError) as error:
      raise FileError(f"cannot read {path}: {one_line(error)}") from None
    raise FileError(f"{path} lacks {left} of {len(self.time)} frames")


@dataclasses.dataclass(frozen=True)
class Dataset:
  """A dataset on disk."""

  fps: float
  names: Mapping[str, list[str]]
  """Column of numbers -> names of its numbers."""

  episodes: list[Episode]
  about: Json
  """What the writer added."""


def read(folder: Path | str) -> Dataset:
  """Reads a dataset of this robot: joint angles and gripper, actions and the rest.

  Raises:
    ConfigError: pyarrow is missing.
    FileError: The folder is not a dataset of version 3, is damaged, or lacks
      "observation.state" or "action" of 7 numbers.
  """
  layout.check_available()
  folder = Path(folder)
  if not layout.is_dataset(folder):
    raise FileError(f"{str(folder)!r} is no dataset: it has no {layout.INFO}")
  try:
    return _read(folder)
  except UserError as error:
    raise FileError(f"{str(folder)!r}: {error}") from None
  except Exception as error:  # Whatever the libraries raise for damaged files.
    raise FileError(
      f"{str(folder)!r} is damaged: {type(error).__name__}: {one_line(error)}"
    ) from None


def _read(folder: Path) -> Dataset:
  info = json.loads((folder / layout.INFO).read_text(encoding="utf-8"))
  if info["codebase_version"] != layout.VERSION:
    raise FileError(
      f"its version is {str(info['codebase_version'])[:20]}, not {layout.VERSION}"
    )
  features = info["features"]
  for name in (STATE, ACTION):
    if features.get(name, {}).get("shape") != [7]:
      raise FileError(f"it has no {name} of 7 numbers: six joints and the gripper")
  vectors = {
    name: _names(about)
    for name, about in features.items()
    if about["dtype"].startswith("float")
    and len(about["shape"]) == 1
    and name not in COUNTERS
  }
  path = folder / layout.ABOUT
  about = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
  fps = float(info["fps"])
  if not 0.0 < fps < math.inf:
    raise FileError(f"its frames per second are {fps}")
  found = Dataset(fps, vectors, [], about)
  if not info["total_episodes"]:
    return found
  table = _table(folder / layout.TASKS)
  texts = next(name for name in table.column_names if name != "task_index")
  tasks = dict(
    zip(table["task_index"].to_pylist(), table[texts].to_pylist(), strict=True)
  )
  rows = [
    row
    for path in sorted(folder.glob(layout.ALL_EPISODES))
    for row in _table(path).to_pylist()
  ]
  files: dict[str, Any] = {}
  for row in sorted(rows, key=lambda row: row["episode_index"]):
    if row["episode_index"] >= info["total_episodes"]:
      continue  # The writer was stopped before it had counted the episode.
    name = info["data_path"].format(
      chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
    )
    if name not in files:
      files = {name: _table(folder / name)}
    found.episodes.append(_episode(folder, info, row, name, files[name], tasks, found))
  if len(found.episodes) != info["total_episodes"]:
    raise FileError(
      f"it lists {len(found.episodes)} of {info['total_episodes']} episodes"
    )
  return found


def _episode(
  folder: Path,
  info: dict[str, Any],
  row: dict[str, Any],
  name: str,
  data: Any,
  tasks: dict[int, str],
  dataset: Dataset,
) -> Episode:
  """Returns the episode of a row of meta/episodes; ``data`` is its file ``name``."""
  mine = data["episode_index"].to_numpy() == row["episode_index"]
  columns = {
    key: _numbers(data[key], mine) for key in dataset.names.keys() | {"task_index"}
  }
  for key, names in dataset.names.items():
    width = columns[key].shape[1]
    if [width] != info["features"][key]["shape"] or len(names) > width:
      raise FileError(f"{key} in {name} has {width} numbers, unlike in {layout.INFO}")
  count = len(columns[ACTION])
  if count != row["length"] or not count:
    raise FileError(
      f"{name} has {count} frames of episode {row['episode_index']}, "
      f"not {row['length']}"
    )
  task = tasks[int(columns.pop("task_index")[0, 0])]
  labeled = SUCCESS in data.column_names
  success = bool(_numbers(data[SUCCESS], mine)[-1, 0]) if labeled else None
  videos = {}
  for key, about in info["features"].items():
    if about["dtype"] == "video":
      path = info["video_path"].format(
        video_key=key,
        chunk_index=row[f"videos/{key}/chunk_index"],
        file_index=row[f"videos/{key}/file_index"],
      )
      videos[key] = folder / path, float(row[f"videos/{key}/from_timestamp"])
  time, period = np.arange(count) / dataset.fps, 1.0 / dataset.fps
  return Episode(task, time, period, columns, success, videos)


def _table(path: Path) -> Any:
  """Returns a table, unless it would take more than the memory of the machine."""
  import pyarrow.parquet as pq

  with pq.ParquetFile(path) as file:
    groups = range(file.metadata.num_row_groups)
    size = sum(file.metadata.row_group(i).total_byte_size for i in groups)
    if size > (runtime.host_memory() or 1 << 32):
      raise FileError(f"{path.name} takes {size} bytes, more than the memory")
    return file.read()


def _names(feature: Json) -> list[str]:
  """Returns the names of a column's numbers, which may be in groups."""
  names = feature.get("names") or []
  names = sum(names.values(), []) if isinstance(names, dict) else names
  return [str(name) for name in names]


def _numbers(column: Any, rows: np.ndarray) -> np.ndarray:
  """Returns rows of a column of numbers or of lists of numbers as f64[n, k]."""
  values, count = column.combine_chunks(), len(column)
  if hasattr(values, "flatten") and hasattr(values.type, "value_type"):
    values = values.flatten()
  values = values.to_numpy(zero_copy_only=False).astype(np.float64)
  return values.reshape(count, -1)[rows]
