"""Checkpoints: real files in a temporary folder, compared bit by bit."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
import dataclasses
import gc
import json
import os
from pathlib import Path
import resource
import shutil
import subprocess
import sys
import time
from typing import Any

from flax import struct
from hypothesis import given, settings, strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.errors import UserError
from apnpql_jax.runs import (
  abandoned_tasks,
  checkpoint_reader,
  checkpoint_record,
  run_folder,
)
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter, SaveError
from apnpql_jax.training import resume

CONFIG = TrainConfig()

# When one array cannot be read, Orbax closes its event loop while it reads the others.
pytestmark = pytest.mark.filterwarnings(
  "ignore::pytest.PytestUnraisableExceptionWarning"
)


class State(struct.PyTreeNode):
  """One leaf of every kind a training state has."""

  params: dict[str, jax.Array]
  opt: optax.OptState
  images: jax.Array
  flags: jax.Array
  steps: jax.Array
  key: jax.Array
  keys: jax.Array
  raw_key: jax.Array
  empty: jax.Array
  absent: jax.Array | None = None


def _state(seed: int = 0, images: int = 5) -> State:
  rng = np.random.default_rng(seed)
  # Values that a detour through another dtype or through text would change.
  kernel = rng.integers(0, 2**32, (3, 4), np.uint32).view(np.float32)
  kernel[0] = [np.nan, np.inf, -0.0, 1e-42]
  params = {"kernel": jnp.asarray(kernel), "bias": jnp.ones((4,), jnp.bfloat16)}
  return State(
    params=params,
    opt=optax.adam(1e-3).init({"kernel": jnp.asarray(rng.normal(size=3))}),
    images=jnp.asarray(rng.integers(0, 256, (images, 2, 3), np.uint8)),
    flags=jnp.asarray(rng.random(7) < 0.5),
    steps=jnp.asarray(2**31 - 1 - seed, jnp.int32),
    key=jax.random.key(seed),
    keys=jax.random.split(jax.random.key(seed, impl="rbg"), 3),
    raw_key=jax.random.PRNGKey(seed),
    empty=jnp.zeros((4, 0, 3)),  # As mocap_pos of a scene without mocap bodies.
  )


ODD = "ä %41 #{x}~\n:$HOME'\",;&@-"
"""Characters that mean something to shells, URLs, format strings or file systems."""


def test_a_path_of_odd_characters_keeps_its_checkpoints(tmp_path):
  run = run_folder.create(tmp_path / ODD / ODD, CONFIG).path
  example = {"learner": {"x": jnp.arange(3)}}
  with CheckpointWriter(run, CONFIG, keep=2) as writer:
    for step in (1, 2):
      writer.save(step, example)
  found = checkpoint_reader.restore(run, None, example)
  np.testing.assert_array_equal(found.items["learner"]["x"], np.arange(3))
  assert checkpoint_reader.all_steps(run) == [1, 2] and found.step == 2


@pytest.mark.parametrize("character", "*?[]\\")
def test_a_path_in_which_orbax_loses_checkpoints_is_refused(tmp_path, character):
  """Anywhere in the path, and before anything is written."""
  above = tmp_path / f"a{character}1"
  with pytest.raises(UserError, match="cannot be kept"):
    run_folder.create(above / "run", CONFIG)
  assert not above.exists()
  run = run_folder.create(tmp_path / "run", CONFIG).path.rename(above)
  with pytest.raises(UserError, match="cannot be kept"):
    run_folder.check_resumable(run, CONFIG)
  if character == "\\":
    with pytest.raises(UserError, match="cannot be kept"):
      run_folder.open_run(run)
  else:
    assert run_folder.open_run(run).config == CONFIG


def _bits(leaf: Any) -> tuple[str, tuple[int, ...], bytes]:
  plain = leaf
  if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
    plain = jax.random.key_data(leaf)
  return str(leaf.dtype), leaf.shape, np.asarray(plain).tobytes()


def _assert_same_bits(a: Any, b: Any) -> None:
  assert jax.tree.structure(a) == jax.tree.structure(b)
  assert jax.tree.map(_bits, a) == jax.tree.map(_bits, b)


def _restore(run: Path, step: int | None, example: Any, **settings: Any) -> Any:
  examples = {"state": example}
  return checkpoint_reader.restore(run, step, examples, **settings).items["state"]


def _save(run: Path, *states: tuple[int, State, float | None], keep: int = 9) -> None:
  with CheckpointWriter(run, CONFIG, keep=keep) as writer:
    for step, state, rate in states:
      writer.save(step, {"state": state}, success_rate=rate)


def test_every_leaf_comes_back_bit_by_bit(tmp_path: Path):
  state = _state(3)
  _save(tmp_path, (100, state, None))
  for example in (_state(4), jax.eval_shape(lambda: _state(4))):
    restored = _restore(tmp_path, 100, example, config=CONFIG)
    _assert_same_bits(restored, state)
    drawn = jax.random.uniform(restored.keys[1])
    assert drawn == jax.random.uniform(state.keys[1])


def test_another_process_reads_the_same(tmp_path: Path):
  _save(tmp_path, (7, _state(1), None))
  code = (
    "import pathlib, sys; sys.path.insert(0, sys.argv[2]);"
    "import test_checkpoint as t;"
    "run = pathlib.Path(sys.argv[1]);"
    "t._assert_same_bits(t._restore(run, None, t._state(2)), t._state(1))"
  )
  here = Path(__file__).parent
  command = [sys.executable, "-c", code, str(tmp_path), str(here)]
  subprocess.run(command, check=True, cwd=here.parents[1])


def test_donating_a_state_while_it_is_saved_does_not_change_the_file(tmp_path: Path):
  big = jnp.arange(8_000_000, dtype=jnp.int32)  # Still being written on return.
  step = jax.jit(lambda x: x * 0 - 7, donate_argnums=0)
  with CheckpointWriter(tmp_path, CONFIG, keep=1) as writer:
    writer.save(1, {"state": {"x": big}})
    after = jax.block_until_ready(step(big))
  assert int(after[0]) == -7
  restored = _restore(tmp_path, 1, {"x": after})
  np.testing.assert_array_equal(restored["x"], np.arange(8_000_000))


def test_newest_and_best_are_kept(tmp_path: Path):
  rates = {1: 0.2, 2: 0.9, 3: 0.9, 4: 0.1, 5: None, 6: 0.3}
  _save(tmp_path, *((s, _state(s), r) for s, r in rates.items()), keep=2)
  assert checkpoint_reader.all_steps(tmp_path) == [3, 5, 6]
  assert checkpoint_reader.latest_step(tmp_path) == 6
  assert checkpoint_reader.best_step(tmp_path) == 3
  # A writer opened later still knows which was best.
  _save(tmp_path, (7, _state(7), 0.5), (8, _state(8), None), keep=2)
  assert checkpoint_reader.all_steps(tmp_path) == [3, 7, 8]
  _assert_same_bits(_restore(tmp_path, 3, _state()), _state(3))


def test_a_step_is_saved_once(tmp_path: Path):
  with CheckpointWriter(tmp_path, CONFIG, keep=2) as writer:
    writer.save(1, {"state": _state(1)})
    writer.save(1, {"state": _state(2)})
  _assert_same_bits(_restore(tmp_path, 1, _state()), _state(1))


def test_resuming_from_an_earlier_step_loses_nothing(tmp_path: Path):
  _save(tmp_path, *((step, _state(step), None) for step in (10, 20, 30)))
  (tmp_path / "metrics.jsonl").write_text('{"step": 30}\n')
  assert resume.set_aside(tmp_path, 30) is None
  aside = resume.set_aside(tmp_path, 10)
  assert checkpoint_reader.all_steps(tmp_path) == [10] and aside is not None
  assert (aside / "metrics.jsonl").read_text() == '{"step": 30}\n'
  # They can be put back as they were; a second resume keeps only what it finds.
  _save(tmp_path, (20, _state(21), None))
  assert resume.set_aside(tmp_path, 10) == aside
  assert sorted(path.name for path in aside.iterdir()) == ["20", "metrics.jsonl"]
  (aside / "20").rename(tmp_path / "checkpoints" / "20")
  _assert_same_bits(_restore(tmp_path, 20, _state()), _state(21))


def test_other_settings_are_refused_by_name(tmp_path: Path):
  _save(tmp_path, (1, _state(), None))
  agent = AgentConfig(gamma=0.95, num_atoms=21)
  other = dataclasses.replace(CONFIG, agent=agent, seed=5)
  with pytest.raises(UserError) as error:
    _restore(tmp_path, 1, _state(), config=other)
  for part in ("agent.gamma 0.99 -> 0.95", "agent.num_atoms 51 -> 21", "seed 0 -> 5"):
    assert part in str(error.value)
  assert "\n" not in str(error.value)
  longer = dataclasses.replace(CONFIG, total_steps=10**6, video=False)
  _restore(tmp_path, 1, _state(), config=longer)


def test_a_checkpoint_from_before_a_setting_is_read_as_it_was(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
  def as_then(*lacking: str) -> Callable[[TrainConfig], str]:
    def to_json(config: TrainConfig) -> str:
      data = json.loads(config_to_json(config))
      kept = {k: v for k, v in data["agent"].items() if k not in lacking}
      return json.dumps(data | {"agent": kept})

    return to_json

  monkeypatch.setattr(checkpoint_record, "config_to_json", as_then("residual_blocks"))
  _save(tmp_path, (1, _state(1), None))
  _assert_same_bits(_restore(tmp_path, 1, _state(), config=CONFIG), _state(1))
  deeper = dataclasses.replace(CONFIG, agent=AgentConfig(residual_blocks=2))
  with pytest.raises(UserError, match="agent.residual_blocks 0 -> 2"):
    _restore(tmp_path, 1, _state(), config=deeper)
  # A setting that was always there cannot be missing.
  monkeypatch.setattr(checkpoint_record, "config_to_json", as_then("gamma"))
  _save(tmp_path, (2, _state(2), None))
  with pytest.raises(UserError, match="checkpoint 2 of .*'agent.gamma' is missing"):
    _restore(tmp_path, None, _state(), config=CONFIG)


def test_other_leaves_are_refused_by_name(tmp_path: Path):
  state = _state()
  _save(tmp_path, (1, state, None))
  cast = dataclasses.replace(state, images=state.images.astype(jnp.float32))
  with pytest.raises(UserError, match=r"uint8\[5, 2, 3\] at images.*float32"):
    _restore(tmp_path, 1, cast)
  with pytest.raises(UserError, match=r"uint8\[5, 2, 3\] at images.*uint8\[6"):
    _restore(tmp_path, 1, _state(images=6))
  more = dataclasses.replace(state, params={**state.params, "new": jnp.zeros(2)})
  with pytest.raises(UserError, match=r"holds nothing at params/new"):
    _restore(tmp_path, 1, more)
  with pytest.raises(UserError, match=r"at absent"):
    _restore(tmp_path, 1, dataclasses.replace(state, absent=jnp.zeros(2)))


def test_missing_and_broken_checkpoints_are_refused_in_one_line(tmp_path: Path):
  assert checkpoint_reader.latest_step(tmp_path) is None
  with pytest.raises(UserError, match="has no checkpoint"):
    _restore(tmp_path, None, _state())
  _save(tmp_path, (1, _state(1), None), (2, _state(2), None))
  with pytest.raises(UserError, match="no checkpoint 3; choose from 1, 2"):
    _restore(tmp_path, 3, _state())
  folder = tmp_path / "checkpoints"
  shutil.rmtree(folder / "2" / "state" / "d")
  with pytest.raises(UserError, match="checkpoint 2 of .* cannot be read") as error:
    _restore(tmp_path, 2, _state())
  assert "\n" not in str(error.value)
  # What was cut off while being written is not taken for a checkpoint.
  (folder / "9.orbax-checkpoint-tmp").mkdir()
  assert checkpoint_reader.all_steps(tmp_path) == [1, 2]
  _assert_same_bits(_restore(tmp_path, 1, _state()), _state(1))


def test_another_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  with monkeypatch.context() as later:
    later.setattr(checkpoint_record, "SCHEMA_VERSION", 9)
    _save(tmp_path, (1, _state(), None))
  with pytest.raises(UserError, match="has format 9; this code reads up to 3"):
    _restore(tmp_path, 1, _state())


def test_items_are_read_one_by_one_and_older_ones_fill_in(tmp_path: Path):
  with CheckpointWriter(tmp_path, CONFIG, keep=1) as writer:
    for step in (1, 2, 3, 4):
      items = {"small": _state(step)} | ({"large": _state(9)} if step == 2 else {})
      writer.save(step, items)
  # The newest is kept, and the one that holds what it lacks.
  assert checkpoint_reader.all_steps(tmp_path) == [2, 4]
  found = checkpoint_reader.restore(
    tmp_path, None, {"small": _state(), "large": _state()}
  )
  assert found.step == 4 and found.steps == {"small": 4, "large": 2}
  _assert_same_bits(found.items, {"small": _state(4), "large": _state(9)})
  found = checkpoint_reader.restore(tmp_path, 2, {"small": _state()})
  assert found.items.keys() == {"small"} and found.steps == {"small": 2}


def test_every_kept_checkpoint_keeps_the_older_one_that_fills_it_in(tmp_path: Path):
  with CheckpointWriter(tmp_path, CONFIG, keep=2) as writer:
    for step in (1, 2, 3, 4, 5):
      large = {"large": _state(10 * step)} if step in (2, 5) else {}
      writer.save(step, {"small": _state(step)} | large)
  # 5 holds everything, but 4 lacks what 2 holds.
  assert checkpoint_reader.all_steps(tmp_path) == [2, 4, 5]
  examples = {"small": _state(), "large": _state()}
  found = checkpoint_reader.restore(tmp_path, 4, examples)
  _assert_same_bits(found.items, {"small": _state(4), "large": _state(20)})


def _files(folder: Path) -> list[Path]:
  return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_damage_is_recognized_named_and_the_one_before_taken(tmp_path: Path, damage):
  """One bit or one file of the newest checkpoint at a time, in every one of its files.

  What comes back is either the newest or the one before, never anything else.
  """
  whole = tmp_path / "whole"
  _save(whole, (1, _state(1), None), (2, _state(2), None))
  newest = Path("checkpoints") / "2"
  rng, refused = np.random.default_rng(0), set()
  files = [path.relative_to(whole) for path in _files(whole / newest)]
  for file in files:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    data = bytearray((run / file).read_bytes())
    if damage == "remove" or not data:
      (run / file).unlink()
    elif damage == "cut":
      (run / file).write_bytes(data[: rng.integers(len(data))])
    else:
      data[rng.integers(len(data))] ^= 1 << rng.integers(8)
      (run / file).write_bytes(data)
    found = checkpoint_reader.restore(run, None, {"state": _state()}, config=CONFIG)
    _assert_same_bits(found.items["state"], _state(found.step))
    if found.step == 1:
      (line,) = found.damaged
      assert "checkpoint 2 of " in line and "\n" not in line
      refused.add(file.relative_to(newest).parts[0])
    # It does not keep the run from being written to, either.
    resume.set_aside(run, found.step)
    CheckpointWriter(run, CONFIG, keep=2).close()
    assert checkpoint_reader.latest_step(run) == found.step
    shutil.rmtree(run)
  assert refused == {"meta", "state"}
  gc.collect()  # What Orbax left would complain in another test.


VALUE = st.integers() | st.floats() | st.booleans() | st.none() | st.text()
DEEPER = st.sampled_from([True, True, True, False])


@pytest.fixture(scope="module")
def foreign(tmp_path_factory) -> Path:
  """Returns a run whose record the tests rewrite."""
  run = tmp_path_factory.mktemp("foreign")
  _save(run, (1, _state(1), 0.5))
  return run


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_forged_records_are_rejected_or_equivalent(foreign, data):
  """Replaces one value of a record, and its checksum to match."""
  path = foreign / "checkpoints" / "1" / "meta" / "metadata"
  whole = path.read_text()
  record = json.loads(whole)
  del record["crc32"]
  inside, key = record, data.draw(st.sampled_from(sorted(record)))
  while isinstance(inside[key], dict | list) and inside[key] and data.draw(DEEPER):
    inside = inside[key]
    keys = sorted(inside) if isinstance(inside, dict) else range(len(inside))
    key = data.draw(st.sampled_from(keys))
  inside[key] = data.draw(VALUE | st.lists(VALUE) | st.just({}))
  record["crc32"] = checkpoint_record._checksum(record)
  path.write_text(json.dumps(record))
  try:
    found = checkpoint_reader.restore(foreign, None, {"state": _state()}, config=CONFIG)
    _assert_same_bits(found.items["state"], _state(1))
    assert checkpoint_reader.best_step(foreign) == 1
  except UserError as error:
    assert len(str(error)) < 2000
  finally:
    path.write_text(whole)


def test_without_a_whole_checkpoint_each_is_named(tmp_path: Path):
  _save(tmp_path, (1, _state(1), None), (2, _state(2), None))
  for step in ("1", "2"):
    path = tmp_path / "checkpoints" / step / "meta" / "metadata"
    path.write_text(
      path.read_text().replace('"success_rate": null', '"success_rate": 1')
    )
  with pytest.raises(UserError, match="checkpoint 2 .* damaged.*checkpoint 1 .* dam"):
    _restore(tmp_path, None, _state())


def test_a_full_disk_leaves_the_checkpoints_before_untouched(tmp_path: Path):
  _save(tmp_path, (1, _state(1), None))
  soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
  noise = np.random.default_rng(0).integers(0, 256, 1 << 20, np.uint8)
  big = {"state": {"x": jnp.asarray(noise)}}
  resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 18, hard))
  try:
    with (
      pytest.raises(SaveError, match="^checkpoint 2 could not be saved: .*large"),
      CheckpointWriter(tmp_path, CONFIG, keep=1) as writer,
    ):
      writer.save(2, big)
      writer.wait()
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
  writer.close()
  # What was written of it is gone, and a run that goes on can save.
  assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["1"]
  _assert_same_bits(_restore(tmp_path, None, _state()), _state(1))
  with CheckpointWriter(tmp_path, CONFIG, keep=1) as writer:
    writer.save(3, {"state": _state(3)})
    figures = writer.proceed(wait=True)
  assert figures["checkpoint/mib"] > 0 and figures["checkpoint/wall_s"] > 0
  assert checkpoint_reader.all_steps(tmp_path) == [3]


SAVE_ON_A_FULL_DISK = """
import os, pathlib, resource, sys
sys.path.insert(0, sys.argv[2])
import test_checkpoint as t
from apnpql_jax.runs import abandoned_tasks
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 18, -1))
noise = t.np.random.default_rng(0).integers(0, 256, (8, 1 << 20), t.np.uint8)
state = {str(i): t.jnp.asarray(x) for i, x in enumerate(noise)}
with abandoned_tasks.silenced():
  try:
    with t.CheckpointWriter(pathlib.Path(sys.argv[1]), t.CONFIG, keep=1) as writer:
      writer.save(1, {"state": state})
  except t.SaveError as error:
    print(error, flush=True)
    os._exit(3)
"""


def test_a_full_disk_is_reported_by_one_line(tmp_path: Path):
  here = Path(__file__).parent
  command = [sys.executable, "-c", SAVE_ON_A_FULL_DISK, str(tmp_path), str(here)]
  done = subprocess.run(command, cwd=here.parents[1], capture_output=True, text=True)
  assert done.returncode == 3 and done.stderr == ""
  assert done.stdout.startswith("checkpoint 1 could not be saved: File too large")


def test_a_loop_that_is_open_is_not_silenced():
  loop, called = asyncio.new_event_loop(), []
  with abandoned_tasks.silenced():
    loop.call_soon_threadsafe(called.append, 1)
    loop.call_soon_threadsafe(loop.stop)
    loop.run_forever()
    loop.close()
    loop.call_soon_threadsafe(called.append, 2)
  with pytest.raises(RuntimeError, match="closed"):
    loop.call_soon_threadsafe(called.append, 3)
  assert called == [1]


SAVE_FOR_EVER = """
import itertools, pathlib, sys
sys.path.insert(0, sys.argv[2])
import test_checkpoint as t
run = pathlib.Path(sys.argv[1])
first = (t.checkpoint_reader.latest_step(run) or 0) + 1
with t.CheckpointWriter(run, t.CONFIG, keep=2) as writer:
  for step in itertools.count(first):
    state = t._state(step % 7, images=200_000)
    writer.save(step, {"state": state}, success_rate=0.5)
    writer.wait()
    print(step, flush=True)
"""


def test_a_run_can_be_read_while_it_saves(tmp_path: Path):
  """With one checkpoint kept, the newest one is removed as soon as the next exists."""
  run = run_folder.create(tmp_path / "run", CONFIG).path
  code = SAVE_FOR_EVER.replace("keep=2", "keep=1").replace("200_000", "200")
  here = Path(__file__).parent
  command = [sys.executable, "-c", code, str(run), str(here)]
  with subprocess.Popen(
    command, cwd=here.parents[1], stdout=subprocess.DEVNULL
  ) as process:
    try:
      while (last := checkpoint_reader.latest_step(run)) is None:
        assert process.poll() is None
        time.sleep(0.1)
      first = last
      while last <= first + 15:
        assert process.poll() is None
        for _ in range(10):
          assert run_folder.open_run(run).config == CONFIG
          assert checkpoint_reader.latest_step(run)
          checkpoint_reader.best_step(run)
        found = checkpoint_reader.restore(run, None, {"state": _state(0, images=200)})
        _assert_same_bits(found.items["state"], _state(found.step % 7, images=200))
        assert found.step >= last and not found.damaged
        last = found.step
    finally:
      process.kill()


def test_weights_of_a_checkpoint_that_a_run_removes_are_not_those_of_another(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
  """The best checkpoint stays, and would have all items."""
  read = checkpoint_record.read
  _save(tmp_path, (1, _state(1), 0.9), (2, _state(2), 0.5), keep=1)

  def read_early(run: Path, step: int) -> checkpoint_record.Record:
    monkeypatch.setattr(checkpoint_record, "read", read)
    record = read(run, step)
    _save(run, (3, _state(3), 0.5), keep=1)
    return record

  monkeypatch.setattr(checkpoint_record, "read", read_early)
  found = checkpoint_reader.restore(tmp_path, None, {"state": _state()})
  assert checkpoint_reader.all_steps(tmp_path) == [1, 3] and found.step == 3
  _assert_same_bits(found.items["state"], _state(3))


def test_a_checkpoint_that_replaces_the_only_one_is_seen(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
  """The listing is from before, and the folders are looked at afterwards."""
  listdir = os.listdir
  _save(tmp_path, (1, _state(1), 0.5))

  def list_early(path: Any) -> list[str]:
    monkeypatch.setattr(os, "listdir", listdir)
    names = listdir(path)
    _save(tmp_path, (2, _state(2), 0.5), keep=1)
    return names

  monkeypatch.setattr(os, "listdir", list_early)
  found = checkpoint_reader.restore(tmp_path, None, {"state": _state()})
  assert found.step == 2


def test_records_are_read_again_if_a_run_replaces_its_checkpoint(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
  read = checkpoint_record.read
  _save(tmp_path, (1, _state(1), 0.5))

  def read_late(run: Path, step: int) -> checkpoint_record.Record:
    monkeypatch.setattr(checkpoint_record, "read", read)
    _save(run, (2, _state(2), 0.5), keep=1)
    return read(run, step)

  monkeypatch.setattr(checkpoint_record, "read", read_late)
  assert checkpoint_reader.best_step(tmp_path) == 2


@pytest.mark.parametrize(
  "moments", [3, pytest.param(20, marks=pytest.mark.slow, id="20")]
)
def test_a_process_killed_while_it_saves_loses_one_save_at_most(tmp_path, moments):
  """Killed at random moments of a loop that does nothing but save."""
  rng, printed = np.random.default_rng(moments), 0
  here = Path(__file__).parent
  command = [sys.executable, "-c", SAVE_FOR_EVER, str(tmp_path), str(here)]
  for _ in range(moments):
    with subprocess.Popen(
      command, cwd=here.parents[1], stdout=subprocess.PIPE, text=True
    ) as process:
      assert process.stdout is not None
      printed = int(process.stdout.readline())
      time.sleep(rng.uniform(0.0, 0.6))
      process.kill()
      printed = max(
        [printed, *(int(line) for line in process.stdout if line.endswith("\n"))]
      )
    step = checkpoint_reader.latest_step(tmp_path)
    assert step is not None and step in (printed, printed + 1)
    found = checkpoint_reader.restore(
      tmp_path, None, {"state": _state(0, images=200_000)}
    )
    assert found.step == step and not found.damaged
    _assert_same_bits(found.items["state"], _state(step % 7, images=200_000))
