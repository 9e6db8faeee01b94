"""Datasets of LeRobot: what is written is read, by other libraries too."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
import shutil
import signal
import subprocess
import sys

import av
import numpy as np
import pytest

from apnpql_jax.atomic import replacing
from apnpql_jax.data import lerobot
from apnpql_jax.data.lerobot import layout
from apnpql_jax.data.lerobot.video import Video
from apnpql_jax.errors import ConfigError, FileError, UserError

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

STATE = [f"joint_{i}" for i in range(7)]
WRENCH = "observation.wrench"
WIDE, SMALL = f"{lerobot.IMAGES}global", f"{lerobot.IMAGES}wrist"
SIZES = {WIDE: (48, 64), SMALL: (30, 53)}
VECTORS = lerobot.STATE, lerobot.ACTION, WRENCH
FPS = 1 / 0.15
LENGTHS = (5, 9, 1)


def frames(seed: int, count: int) -> list[dict[str, np.ndarray]]:
  """Returns frames with smooth images that differ."""
  rng = np.random.default_rng(seed)
  found = []
  for i in range(count):
    numbers = {
      lerobot.STATE: rng.normal(size=7),
      lerobot.ACTION: rng.normal(size=7),
      WRENCH: rng.normal(size=6),
    }
    images = {}
    for name, (height, width) in SIZES.items():
      image = np.full((height, width, 3), (20 * i, 60, 40 * seed), np.uint8)
      image[4 : 8 + i, 10:20] = (200, 30, 90)
      images[name] = image
    found.append(numbers | images)
  return found


def writer(folder: Path) -> lerobot.Writer:
  return lerobot.Writer(
    folder,
    fps=FPS,
    vectors={lerobot.STATE: STATE, lerobot.ACTION: STATE, WRENCH: list("xyzabc")},
    images=SIZES,
    robot_type="arm",
    about={"contract": "abc"},
  )


def write(folder: Path) -> list[list[dict[str, np.ndarray]]]:
  """Writes three episodes; returns their frames."""
  episodes = [frames(seed, count) for seed, count in enumerate(LENGTHS)]
  with writer(folder) as dataset:
    for index, episode in enumerate(episodes):
      for frame in episode:
        dataset.add(frame)
      dataset.end_episode(f"task {index % 2}", index != 1)
  return episodes


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, list[list[dict[str, np.ndarray]]]]:
  folder = tmp_path_factory.mktemp("lerobot") / "dataset"
  return folder, write(folder)


def test_what_is_written_is_read(written):
  folder, episodes = written
  dataset = lerobot.read(folder)
  assert dataset.fps == FPS and dataset.about == {"contract": "abc"}
  assert dataset.names[WRENCH] == list("xyzabc")
  assert [x.task for x in dataset.episodes] == ["task 0", "task 1", "task 0"]
  assert [x.success for x in dataset.episodes] == [True, False, True]
  for episode, expected in zip(dataset.episodes, episodes, strict=True):
    state, action, wrench = (
      np.array([x[name] for x in expected], np.float32)
      for name in (lerobot.STATE, lerobot.ACTION, WRENCH)
    )
    np.testing.assert_array_equal(episode.joints, state[:, :6])
    np.testing.assert_array_equal(episode.gripper, state[:, 6])
    np.testing.assert_array_equal(episode.actions, action)
    np.testing.assert_array_equal(episode.columns[WRENCH], wrench)
    np.testing.assert_allclose(episode.time, 0.15 * np.arange(len(expected)))
    for name in SIZES:
      images = [*episode.images(name)]
      assert len(images) == len(expected)
      for image, frame in zip(images, expected, strict=True):
        assert image.shape == frame[name].shape
        assert abs(image.astype(int) - frame[name]).mean() < 2


def test_episodes_may_share_a_file(written, tmp_path):
  """As LeRobot writes them; its lists are of any length, and names may be in groups."""
  folder = tmp_path / "dataset"
  shutil.copytree(written[0], folder)
  paths = sorted((folder / "data").rglob("*.parquet"))
  table = pa.concat_tables([pq.read_table(path) for path in paths])
  loose = pa.schema(
    [
      pa.field(x.name, pa.list_(pa.float32()) if x.name in VECTORS else x.type)
      for x in table.schema
    ]
  )
  for path in paths[1:]:
    path.unlink()
  pq.write_table(table.cast(loose), paths[0])
  for path in (folder / "meta/episodes").rglob("*.parquet"):
    (row,) = pq.read_table(path).to_pylist()
    pq.write_table(pa.Table.from_pylist([row | {"data/file_index": 0}]), path)
  _damage(
    folder,
    "meta/info.json",
    lambda data: json.dumps(_in_groups(json.loads(data))).encode(),
  )
  for a, b in zip(
    lerobot.read(folder).episodes, lerobot.read(written[0]).episodes, strict=True
  ):
    for name in VECTORS:
      np.testing.assert_array_equal(a.columns[name], b.columns[name])
    assert a.success == b.success and a.task == b.task
  assert lerobot.read(folder).names == lerobot.read(written[0]).names


def _in_groups(info: dict) -> dict:
  for name in VECTORS:
    info["features"][name]["names"] = {"motors": info["features"][name]["names"]}
  return info


def test_the_files_are_those_of_the_format(written):
  """As LeRobot 0.4.4 reads them, whose sources name each of these."""
  folder, episodes = written
  info = json.loads((folder / "meta/info.json").read_text())
  assert info["codebase_version"] == "v3.0" and info["robot_type"] == "arm"
  assert (info["total_episodes"], info["total_frames"]) == (3, sum(LENGTHS))
  assert info["total_tasks"] == 2 and info["splits"] == {"train": "0:3"}
  assert info["features"][SMALL]["shape"] == [30, 53, 3]
  assert info["features"][lerobot.ACTION] == {
    "dtype": "float32",
    "shape": [7],
    "names": STATE,
  }
  rows = []
  for index, count in enumerate(LENGTHS):
    row = pq.read_table(folder / f"meta/episodes/chunk-000/file-{index:03d}.parquet")
    (row,) = row.to_pylist()
    rows.append(row)
    assert row["episode_index"] == index and row["length"] == count
    assert row["dataset_to_index"] - row["dataset_from_index"] == count
    place = {"chunk_index": row["data/chunk_index"], "file_index": index}
    table = pq.read_table(folder / info["data_path"].format(**place))
    assert str(table.schema.field("action").type).startswith("fixed_size_list")
    kinds = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert kinds["timestamp"] == "float" and kinds["task_index"] == "int64"
    assert kinds["next.success"] == "bool"
    columns = table.to_pydict()
    assert columns["index"] == [
      *range(row["dataset_from_index"], row["dataset_to_index"])
    ]
    assert columns["frame_index"] == [*range(count)]
    assert columns["task_index"] == [index % 2] * count
    assert columns["next.success"] == [False] * (count - 1) + [index != 1]
    np.testing.assert_allclose(columns["timestamp"], np.arange(count) / FPS, rtol=1e-6)
    for name, (height, width) in SIZES.items():
      video = folder / info["video_path"].format(video_key=name, **place)
      with av.open(str(video)) as file:
        stream = file.streams.video[0]
        assert (stream.height, stream.width) == (height, width)
        times = [x.time for x in file.decode(stream)]
      # LeRobot wants frames within 0.1 ms of their time stamps.
      begin = row[f"videos/{name}/from_timestamp"]
      np.testing.assert_allclose(times, begin + np.arange(count) / FPS, atol=1e-4)
  tasks = pq.read_table(folder / "meta/tasks.parquet")
  assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["task 0", "task 1"]}
  # pandas takes the texts as index, by which LeRobot finds a task.
  about = json.loads(tasks.schema.metadata[b"pandas"])
  assert about["index_columns"] == ["task"]


def test_statistics_are_those_of_all_frames(written):
  folder, episodes = written
  stats = json.loads((folder / "meta/stats.json").read_text())
  frames = [frame for episode in episodes for frame in episode]
  for name in (lerobot.ACTION, WRENCH):
    values = np.array([x[name] for x in frames], np.float32).astype(float)
    np.testing.assert_allclose(stats[name]["mean"], values.mean(0))
    np.testing.assert_allclose(stats[name]["std"], values.std(0))
    np.testing.assert_allclose(stats[name]["min"], values.min(0))
    np.testing.assert_allclose(stats[name]["max"], values.max(0))
    assert stats[name]["count"] == [len(frames)]
  for name in SIZES:
    values = np.array([x[name] for x in frames]).reshape(-1, 3) / 255
    for key in ("mean", "std", "min", "max"):
      found = np.array(stats[name][key])
      assert found.shape == (3, 1, 1)
      np.testing.assert_allclose(found.ravel(), getattr(values, key)(0), atol=1e-9)
  row = pq.read_table(folder / "meta/episodes/chunk-000/file-001.parquet").to_pylist()[
    0
  ]
  values = np.array([x[WIDE] for x in episodes[1]]).reshape(-1, 3) / 255
  for share in (0.01, 0.1, 0.5, 0.9, 0.99):
    found = np.ravel(row[f"stats/{WIDE}/q{round(100 * share):02d}"])
    np.testing.assert_allclose(
      found, np.quantile(values, share, axis=0, method="inverted_cdf"), atol=1e-9
    )


def test_a_killed_writer_leaves_whole_episodes(tmp_path):
  """Killed in the middle of the third episode."""
  folder = tmp_path / "dataset"
  program = f"""
import os, signal
from pathlib import Path
import test_lerobot as t
dataset = t.writer(Path({str(folder)!r}))
for seed in range(3):
  for frame in t.frames(seed, 4):
    dataset.add(frame)
  if seed < 2:
    dataset.end_episode("task", True)
os.kill(os.getpid(), signal.SIGKILL)
"""
  paths = [str(Path(__file__).parent), *filter(None, sys.path)]
  done = subprocess.run(
    [sys.executable, "-c", f"import sys; sys.path[:0] = {paths!r}\n{program}"],
    timeout=120,
    check=False,
  )
  assert done.returncode == -signal.SIGKILL
  dataset = lerobot.read(folder)
  assert [len(x.time) for x in dataset.episodes] == [4, 4]
  assert len([*dataset.episodes[1].images(SMALL)]) == 4


def test_a_table_that_was_being_written_is_left_out(written, tmp_path):
  folder = shutil.copytree(written[0], tmp_path / "dataset")
  table = folder / layout.EPISODES.format(**layout.place(0))
  with replacing(table.with_stem("file-003")) as part:
    part.write_bytes(table.read_bytes()[:100])
    assert len(lerobot.read(folder).episodes) == 3


def test_an_unfinished_episode_leaves_nothing(tmp_path):
  folder = tmp_path / "dataset"
  with writer(folder) as dataset:
    for frame in frames(0, 3):
      dataset.add(frame)
    dataset.discard_episode()
    for frame in frames(1, 2):
      dataset.add(frame)
    dataset.end_episode("task", False)
    dataset.add(frames(2, 1)[0])
  assert [len(x.time) for x in lerobot.read(folder).episodes] == [2]
  assert not [*folder.rglob("*.part*")]


def test_frames_must_have_the_columns(tmp_path):
  good = frames(0, 1)[0]
  with writer(tmp_path / "dataset") as dataset:
    with pytest.raises(ValueError, match="a frame has"):
      dataset.add({k: v for k, v in good.items() if k != WRENCH})
    with pytest.raises(ValueError, match="action has shape"):
      dataset.add(good | {lerobot.ACTION: np.zeros(6)})
    with pytest.raises(ValueError, match="observation.images.wrist is float64"):
      dataset.add(good | {SMALL: np.zeros((30, 53, 3))})
    with pytest.raises(ValueError, match="an episode needs a frame"):
      dataset.end_episode("task", True)


def test_a_folder_in_use_is_not_written_to(written):
  with pytest.raises(FileError, match="exists; name a folder to make"):
    writer(written[0])


def _damage(folder: Path, name: str, change) -> None:
  path = folder / name
  path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
  ("name", "change"),
  [
    ("meta/info.json", lambda data: data[:40]),
    ("meta/info.json", lambda data: b"[]"),
    ("meta/tasks.parquet", lambda data: data[:-20]),
    ("meta/episodes/chunk-000/file-001.parquet", lambda data: b""),
    ("data/chunk-000/file-002.parquet", lambda data: data[: len(data) // 2]),
  ],
)
def test_damage_is_one_line(tmp_path, name, change):
  folder = tmp_path / "dataset"
  write(folder)
  _damage(folder, name, change)
  with pytest.raises(UserError) as caught:
    lerobot.read(folder)
  assert str(folder) in str(caught.value) and "\n" not in str(caught.value)
  assert "damaged" in str(caught.value)


@pytest.mark.parametrize(
  ("key", "change", "words"),
  [
    ("fps", lambda _: 0, "its frames per second are 0.0"),
    ("fps", lambda _: -5, "its frames per second are -5.0"),
    ("names", lambda names: [*names, "w"], "observation.wrench in .* has 6 numbers"),
    ("shape", lambda _: [5], "observation.wrench in .* has 6 numbers"),
  ],
)
def test_numbers_that_do_not_fit_are_one_line(written, tmp_path, key, change, words):
  folder = tmp_path / "dataset"
  shutil.copytree(written[0], folder)
  info = json.loads((folder / "meta/info.json").read_text())
  place = info if key == "fps" else info["features"][WRENCH]
  place[key] = change(place[key])
  (folder / "meta/info.json").write_text(json.dumps(info))
  with pytest.raises(FileError, match=words):
    lerobot.read(folder)


def test_videos_of_episodes_may_share_a_file(written, tmp_path):
  """An episode, even of one frame, is found by its time and read to its end only."""
  folder, episodes = tmp_path / "dataset", written[1]
  shutil.copytree(written[0], folder)
  path = folder / f"videos/{SMALL}/chunk-000/file-000.mp4"
  video = Video(path.with_name("joined"), SIZES[SMALL], FPS)
  for frame in itertools.chain(*episodes):
    video.add(frame[SMALL])
  video.finish(path)
  starts = np.cumsum([0, *LENGTHS]) / FPS
  for begin, row in zip(
    starts, sorted((folder / "meta/episodes").rglob("*.parquet")), strict=False
  ):
    (about,) = pq.read_table(row).to_pylist()
    about |= {f"videos/{SMALL}/file_index": 0, f"videos/{SMALL}/from_timestamp": begin}
    pq.write_table(pa.Table.from_pylist([about]), row)
  found = lerobot.read(folder).episodes
  for episode, expected in zip(found, episodes, strict=True):
    images = np.array([*episode.images(SMALL)], int)
    assert abs(images - np.array([x[SMALL] for x in expected])).mean() < 2
  with av.open(str(path)) as file:
    *_, last = (x for x in file.demux(video=0) if x.size)
  path.write_bytes(path.read_bytes().replace(bytes(last), b"\xff" * last.size))
  assert len([*found[0].images(SMALL)]) == LENGTHS[0]
  with pytest.raises(FileError, match="cannot read|lacks 1 of 1"):
    [*found[2].images(SMALL)]


def test_missing_parts_are_named(tmp_path):
  folder = tmp_path / "dataset"
  with pytest.raises(FileError, match="is no dataset: it has no meta/info.json"):
    lerobot.read(folder)
  write(folder)
  (folder / "meta/episodes/chunk-000/file-001.parquet").unlink()
  with pytest.raises(FileError, match="lists 2 of 3 episodes"):
    lerobot.read(folder)
  video = folder / f"videos/{SMALL}/chunk-000/file-000.mp4"
  write(tmp_path / "other")
  broken = tmp_path / "other" / video.relative_to(folder)
  broken.write_bytes(broken.read_bytes()[:50])
  with pytest.raises(FileError, match="cannot read"):
    [*lerobot.read(tmp_path / "other").episodes[0].images(SMALL)]
  _damage(folder, "meta/info.json", lambda x: x.replace(b"v3.0", b"v2.1"))
  with pytest.raises(FileError, match="version is v2.1, not v3.0"):
    lerobot.read(folder)


def test_a_missing_package_is_one_line(tmp_path, monkeypatch):
  monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
  with pytest.raises(ConfigError, match=r"pip install 'apnpql-jax\[lerobot\]'"):
    writer(tmp_path / "dataset")
