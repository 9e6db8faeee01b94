"""Rings in segments: real files, written while the rings change."""

from __future__ import annotations

import functools
import json
import operator
from pathlib import Path
import resource
import shutil
import subprocess
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.errors import UserError
from apnpql_jax.runs import checkpoint_reader, checkpoint_record, leaves, segments
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter, SaveError
from apnpql_jax.runs.segments import Ring
from apnpql_jax.training import resume

CONFIG = TrainConfig()
LENGTH, CHUNK = 24, 2
ROWS = 5
"""Indices per part; no divisor of the length."""

pytestmark = pytest.mark.filterwarnings(
  "ignore::pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(segments, "PART_BYTES", ROWS * 2 * (64 + 4))


def slots(first: int, count: int) -> dict[str, jax.Array]:
  """Returns the slots that are appended as number ``first`` and later."""
  number = np.arange(first, first + count)[:, None]
  image = np.random.default_rng(0).integers(0, 256, (1000, 2, 64), np.uint8)
  return {
    "image": jnp.asarray(image[number[:, 0] % 1000]),
    "reward": jnp.asarray(np.array([0.5, 1.5], np.float32) + number, jnp.float32),
  }


@functools.partial(jax.jit, donate_argnums=0)
def append(ring: dict, chunk: dict, cursor: int) -> dict:
  put = jax.lax.dynamic_update_slice_in_dim
  return {name: put(x, chunk[name], cursor, axis=0) for name, x in ring.items()}


class Training:
  """A ring that grows as in a training, a constant one, and other arrays."""

  def __init__(self, added: int = 0):
    empty = {"image": jnp.zeros((LENGTH, 2, 64), jnp.uint8)}
    self.ring = empty | {"reward": jnp.zeros((LENGTH, 2))}
    self.fixed, self.added = slots(500, LENGTH), 0
    for _ in range(added // CHUNK):
      self.play()

  def play(self, writer: CheckpointWriter | None = None) -> None:
    chunk = slots(self.added, CHUNK)
    self.ring = append(self.ring, chunk, self.added % LENGTH)
    self.added += CHUNK
    if writer:
      writer.proceed(self.rings)

  @property
  def items(self) -> dict[str, Any]:
    marks = {"marks": jnp.arange(LENGTH) % (self.added + 1) == 0}
    replay = {"agent": self.ring | marks, "expert": self.fixed}
    learner = {"x": jnp.full(3, self.added), "key": jax.random.key(self.added)}
    return {"learner": learner, "replay": replay}

  @property
  def rings(self) -> dict[str, Ring]:
    agent = {f"replay/agent/{name}": x for name, x in self.ring.items()}
    expert = {f"replay/expert/{name}": x for name, x in self.fixed.items()}
    return {
      "agent": Ring(agent, self.added % LENGTH, self.added, CHUNK),
      "expert": Ring(expert, 0, LENGTH, 0),
    }

  def save(self, writer: CheckpointWriter, **settings: Any) -> None:
    writer.save(self.added, self.items, rings=self.rings, **settings)


def bits(added: int) -> dict[str, int]:
  return leaves.checksums(Training(added).items)


def restored(run: Path, step: int | None = None) -> tuple[int, dict[str, int]]:
  example = jax.eval_shape(lambda: Training().items)
  found = checkpoint_reader.restore(run, step, example)
  return found.step, leaves.checksums(found.items)


def on_disk(run: Path) -> set[str]:
  return {path.name for path in (run / "segments").glob("*")}


def in_use(run: Path) -> set[str]:
  used = checkpoint_record.used_segments(run)
  assert used is not None
  return set(map(str, used))


def writer_of(run: Path, training: Training | None = None) -> CheckpointWriter:
  rings = training.rings if training else None
  return CheckpointWriter(run, CONFIG, keep=2, restored=rings)


def test_rings_come_back_bit_for_bit_though_training_continues(tmp_path):
  """Chunks are appended much faster than parts are written."""
  training, rng = Training(), np.random.default_rng(0)
  for resumed in range(3):
    with writer_of(tmp_path, training if resumed else None) as writer:
      for steps in rng.integers(1, 2 * LENGTH // CHUNK, 5):
        for _ in range(steps):
          training.play(writer)
        training.save(writer)
    newest = checkpoint_reader.all_steps(tmp_path)
    assert len(newest) == 2 and newest[-1] == training.added
    for step in newest:
      assert restored(tmp_path, step) == (step, bits(step))
    assert on_disk(tmp_path) == in_use(tmp_path)


def test_a_record_that_cannot_be_read_now_costs_no_segment(tmp_path):
  training = Training(CHUNK)
  with writer_of(tmp_path) as writer:
    training.save(writer)
  before, (record,) = on_disk(tmp_path), tmp_path.glob("checkpoints/*/meta/metadata")
  hidden = record.rename(tmp_path / "hidden")
  record.mkdir()  # Raises an error of the file system, also for an administrator.
  writer_of(tmp_path, training).close()
  assert on_disk(tmp_path) == before
  record.rmdir()
  hidden.rename(record)
  assert restored(tmp_path) == (CHUNK, bits(CHUNK))


def test_only_parts_that_changed_are_written(tmp_path):
  training = Training()

  def written(writer: CheckpointWriter, steps: int) -> int:
    for _ in range(steps):
      training.play(writer)
    before = on_disk(tmp_path) if (tmp_path / "segments").exists() else set()
    training.save(writer)
    figures = writer.proceed(wait=True)
    assert figures["checkpoint/wall_s"] > 0 and figures["checkpoint/mib"] > 0
    return len(on_disk(tmp_path) - before)

  expert = -(-LENGTH // ROWS)
  with writer_of(tmp_path) as writer:
    assert written(writer, 1) == expert + 1  # Nothing of the empty parts.
    assert written(writer, 1) == 1
    assert written(writer, 1) == 2  # Indices 4 and 5.
  with writer_of(tmp_path, training) as writer:  # As after a resume.
    assert written(writer, 1) == 1
    assert written(writer, 100) == expert  # All of the ring, nothing of the expert.
  assert restored(tmp_path) == (training.added, bits(training.added))
  # A writer that does not continue what is on disk writes everything.
  with writer_of(tmp_path) as writer:
    assert written(writer, 1) == 2 * expert


def test_parts_fit_another_size_than_before(tmp_path, monkeypatch):
  training = Training(10)
  with writer_of(tmp_path) as writer:
    training.save(writer)
  monkeypatch.setattr(segments, "PART_BYTES", 1 << 20)
  training.play()
  with writer_of(tmp_path, training) as writer:
    training.save(writer)
  assert restored(tmp_path) == (12, bits(12)) and restored(tmp_path, 10)[1] == bits(10)


def test_a_checkpoint_is_visible_only_once_its_segments_are(tmp_path):
  training = Training(LENGTH)
  writer = writer_of(tmp_path)
  training.save(writer)
  seen = []
  while not seen:
    seen = checkpoint_reader.all_steps(tmp_path)
    whole = {name for name in on_disk(tmp_path) if name.isdigit()}
    assert in_use(tmp_path) <= whole or not seen
    writer.proceed(training.rings)
    time.sleep(0.001)
  assert len(whole) == 2 * -(-LENGTH // ROWS)
  writer.close()


def test_the_checkpoint_before_replaces_one_whose_segment_is_damaged(tmp_path):
  training = Training(6)
  with writer_of(tmp_path) as writer:
    training.save(writer)
    training.play(writer)
    training.save(writer)
  old, new = (
    {x.number for x in checkpoint_record.read(tmp_path, s).segments} for s in (6, 8)
  )
  folder = tmp_path / "segments" / str(max(new - old))
  for file in folder.rglob("d/*"):  # Where OCDBT keeps values.
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
  with pytest.raises(UserError, match="checkpoint 8 of .* (damaged|cannot be read)"):
    restored(tmp_path, 8)
  assert restored(tmp_path) == (6, bits(6))
  shutil.rmtree(folder)
  assert restored(tmp_path) == (6, bits(6))


@pytest.mark.parametrize("ring", ["agent", "expert"])
def test_a_segment_of_all_checkpoints_costs_only_what_was_in_it(tmp_path, ring):
  training = Training(LENGTH)
  with writer_of(tmp_path) as writer:
    training.save(writer)
    training.play(writer)
    training.save(writer)
  newest = checkpoint_record.read(tmp_path, LENGTH + CHUNK).segments
  (bad,) = (x for x in newest if x.ring == ring and x.start == ROWS)
  shutil.rmtree(tmp_path / "segments" / str(bad.number))
  example = jax.eval_shape(lambda: Training().items)
  with pytest.raises(UserError, match="24 of .*26 of|26 of .*24 of"):
    checkpoint_reader.restore(tmp_path, None, example)
  found = checkpoint_reader.restore(tmp_path, None, example, without_segments=True)
  assert found.step == LENGTH + CHUNK and found.lost == [bad]
  assert found.damaged == []
  expected, got = training.items, found.items
  for name, array in expected["replay"][ring].items():
    if name != "marks":
      array = array.at[bad.start : bad.stop].set(0)
      np.testing.assert_array_equal(got["replay"][ring][name], array)
  other = {"agent": "expert", "expert": "agent"}[ring]
  for part in ("learner",), ("replay", other):
    both = [functools.reduce(operator.getitem, part, x) for x in (expected, got)]
    assert leaves.checksums(both[0]) == leaves.checksums(both[1])


def test_segments_of_checkpoints_set_aside_are_kept(tmp_path):
  training = Training()
  with writer_of(tmp_path) as writer:
    for _ in range(2):
      for _ in range(4):
        training.play(writer)
      training.save(writer)
  aside = resume.set_aside(tmp_path, 8)
  assert aside is not None
  training = Training(8)
  with writer_of(tmp_path, training) as writer:
    training.play()
    training.save(writer)
  shutil.rmtree(tmp_path / "checkpoints" / "10")
  (aside / "16").rename(tmp_path / "checkpoints" / "16")
  assert restored(tmp_path) == (16, bits(16))
  # What the next resume sets aside replaces it, and its segments go.
  resume.set_aside(tmp_path, 8)
  shutil.rmtree(aside)
  writer_of(tmp_path, Training(8)).close()
  held = {segment.number for segment in checkpoint_record.read(tmp_path, 8).segments}
  assert on_disk(tmp_path) == set(map(str, held))


def test_a_run_saved_as_before_segments_is_continued(tmp_path):
  training = Training(30)
  with writer_of(tmp_path) as writer:
    writer.save(30, training.items)
  path = tmp_path / "checkpoints" / "30" / "meta" / "metadata"
  record = json.loads(path.read_text())
  assert record.pop("segments") == [] and record.pop("crc32")
  record["schema_version"] = 2
  path.write_text(json.dumps(record | {"crc32": checkpoint_record._checksum(record)}))
  assert restored(tmp_path) == (30, bits(30))
  with writer_of(tmp_path, training) as writer:
    training.play()
    training.save(writer)
  assert restored(tmp_path) == (32, bits(32)) and in_use(tmp_path)


@pytest.mark.parametrize(
  "segment",
  [
    ["agent", 20, 25, 1, {"replay/agent/image": 0}],
    ["agent", -1, 4, 1, {"replay/agent/image": 0}],
    ["agent", 0, 5, "../1", {"replay/agent/image": 0}],
    ["agent", 0, 5, 1, {"replay/agent/none": 0, "replay/agent/image": 0}],
    None,
  ],
)
def test_forged_segments_are_rejected(tmp_path, segment):
  with writer_of(tmp_path) as writer:
    Training(4).save(writer)
  path = tmp_path / "checkpoints" / "4" / "meta" / "metadata"
  record = json.loads(path.read_text())
  del record["crc32"]
  record["segments"] = [segment] if segment else []
  path.write_text(json.dumps(record | {"crc32": checkpoint_record._checksum(record)}))
  with pytest.raises(UserError, match="checkpoint 4 of .* cannot be read"):
    restored(tmp_path)


def test_a_full_disk_leaves_nothing_of_the_segments(tmp_path, monkeypatch):
  training = Training(4)
  with writer_of(tmp_path) as writer:
    training.save(writer)
  before = on_disk(tmp_path)
  noise = np.random.default_rng(0).integers(0, 256, (8, 1 << 20), np.uint8)
  ring = Ring({"replay/big": jnp.asarray(noise)}, 0, 8, 1)
  soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
  resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 18, hard))
  try:
    with (
      pytest.raises(SaveError, match="^checkpoint 6 could not be saved: .*large"),
      writer_of(tmp_path) as writer,
    ):
      writer.save(6, {"replay": {"big": jnp.asarray(noise)}}, rings={"big": ring})
      writer.wait()
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
  assert on_disk(tmp_path) == before == in_use(tmp_path)
  assert restored(tmp_path) == (4, bits(4))


SAVE_FOR_EVER = """
import pathlib, sys
sys.path.insert(0, sys.argv[2])
import test_segments as t
t.segments.PART_BYTES = 1 << 9
run = pathlib.Path(sys.argv[1])
training = t.Training(t.checkpoint_reader.latest_step(run) or 0)
with t.writer_of(run, training if training.added else None) as writer:
  while True:
    training.play(writer)
    if training.added % 6 == 0:
      training.save(writer)
      print(training.added, flush=True)
"""


@pytest.mark.parametrize(
  "moments", [3, pytest.param(20, marks=pytest.mark.slow, id="20")]
)
def test_a_process_killed_at_any_moment_leaves_whole_checkpoints(tmp_path, moments):
  rng, here = np.random.default_rng(moments), Path(__file__).parent
  command = [sys.executable, "-c", SAVE_FOR_EVER, str(tmp_path), str(here)]
  for _ in range(moments):
    with subprocess.Popen(
      command, cwd=here.parents[1], stdout=subprocess.PIPE, text=True
    ) as process:
      assert process.stdout is not None
      for _ in range(2):  # The save before the one that has begun is on disk.
        begun = int(process.stdout.readline())
      time.sleep(rng.uniform(0.0, 1.0))
      process.kill()
    step, found = restored(tmp_path)
    assert step >= begun - 6 and found == bits(step)
    for older in checkpoint_reader.all_steps(tmp_path)[-2:]:
      assert restored(tmp_path, older) == (older, bits(older))
    writer_of(tmp_path, Training(step)).close()
    assert on_disk(tmp_path) == in_use(tmp_path)
