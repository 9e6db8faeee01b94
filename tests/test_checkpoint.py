"""Checkpoints: real files in a temporary folder, compared bit by bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from apnpql_jax import checkpoint
from apnpql_jax.config import AgentConfig, ConfigError, TrainConfig

CONFIG = TrainConfig()


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


def _bits(leaf: Any) -> tuple[str, tuple[int, ...], bytes]:
  plain = leaf
  if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
    plain = jax.random.key_data(leaf)
  return str(leaf.dtype), leaf.shape, np.asarray(plain).tobytes()


def _assert_same_bits(a: Any, b: Any) -> None:
  assert jax.tree.structure(a) == jax.tree.structure(b)
  assert jax.tree.map(_bits, a) == jax.tree.map(_bits, b)


def _save(run: Path, *states: tuple[int, State, float | None], keep: int = 9) -> None:
  with checkpoint.CheckpointWriter(run, CONFIG, keep=keep) as writer:
    for step, state, rate in states:
      assert writer.save(step, state, success_rate=rate)


def test_every_leaf_comes_back_bit_by_bit(tmp_path: Path):
  state = _state(3)
  _save(tmp_path, (100, state, None))
  for example in (_state(4), jax.eval_shape(lambda: _state(4))):
    restored = checkpoint.restore(tmp_path, 100, example, config=CONFIG)
    _assert_same_bits(restored, state)
    drawn = jax.random.uniform(restored.keys[1])
    assert drawn == jax.random.uniform(state.keys[1])


def test_another_process_reads_the_same(tmp_path: Path):
  _save(tmp_path, (7, _state(1), None))
  code = (
    "import pathlib, sys; sys.path.insert(0, sys.argv[2]);"
    "import test_checkpoint as t; from apnpql_jax import checkpoint;"
    "run = pathlib.Path(sys.argv[1]);"
    "t._assert_same_bits(checkpoint.restore(run, None, t._state(2)), t._state(1))"
  )
  here = Path(__file__).parent
  command = [sys.executable, "-c", code, str(tmp_path), str(here)]
  subprocess.run(command, check=True, cwd=here.parent)


def test_donating_a_state_while_it_is_saved_does_not_change_the_file(tmp_path: Path):
  big = jnp.arange(8_000_000, dtype=jnp.int32)  # Still being written on return.
  step = jax.jit(lambda x: x * 0 - 7, donate_argnums=0)
  with checkpoint.CheckpointWriter(tmp_path, CONFIG, keep=1) as writer:
    writer.save(1, {"x": big})
    after = jax.block_until_ready(step(big))
  assert int(after[0]) == -7
  restored = checkpoint.restore(tmp_path, 1, {"x": after})
  np.testing.assert_array_equal(restored["x"], np.arange(8_000_000))


def test_newest_and_best_are_kept(tmp_path: Path):
  rates = {1: 0.2, 2: 0.9, 3: 0.9, 4: 0.1, 5: None, 6: 0.3}
  _save(tmp_path, *((s, _state(s), r) for s, r in rates.items()), keep=2)
  assert checkpoint.all_steps(tmp_path) == [3, 5, 6]
  assert checkpoint.latest_step(tmp_path) == 6
  assert checkpoint.best_step(tmp_path) == 3
  # A writer opened later still knows which was best.
  _save(tmp_path, (7, _state(7), 0.5), (8, _state(8), None), keep=2)
  assert checkpoint.all_steps(tmp_path) == [3, 7, 8]
  _assert_same_bits(checkpoint.restore(tmp_path, 3, _state()), _state(3))


def test_a_step_is_saved_once(tmp_path: Path):
  with checkpoint.CheckpointWriter(tmp_path, CONFIG, keep=2) as writer:
    assert writer.save(1, _state(1))
    assert not writer.save(1, _state(2))
  _assert_same_bits(checkpoint.restore(tmp_path, 1, _state()), _state(1))


def test_resuming_from_an_earlier_step_drops_the_later_ones(tmp_path: Path):
  _save(tmp_path, *((step, _state(step), None) for step in (10, 20, 30)))
  with checkpoint.CheckpointWriter(tmp_path, CONFIG, keep=9, resume_step=10) as writer:
    writer.save(20, _state(21))
  assert checkpoint.all_steps(tmp_path) == [10, 20]
  _assert_same_bits(checkpoint.restore(tmp_path, 20, _state()), _state(21))


def test_other_settings_are_refused_by_name(tmp_path: Path):
  _save(tmp_path, (1, _state(), None))
  agent = AgentConfig(gamma=0.95, num_atoms=21)
  other = dataclasses.replace(CONFIG, agent=agent, seed=5)
  with pytest.raises(ConfigError) as error:
    checkpoint.restore(tmp_path, 1, _state(), config=other)
  for part in ("agent.gamma 0.99 -> 0.95", "agent.num_atoms 51 -> 21", "seed 0 -> 5"):
    assert part in str(error.value)
  assert "\n" not in str(error.value)
  longer = dataclasses.replace(CONFIG, total_steps=10**6, video=False)
  checkpoint.restore(tmp_path, 1, _state(), config=longer)


def test_other_leaves_are_refused_by_name(tmp_path: Path):
  state = _state()
  _save(tmp_path, (1, state, None))
  cast = dataclasses.replace(state, images=state.images.astype(jnp.float32))
  with pytest.raises(ConfigError, match=r"uint8\[5, 2, 3\] at images.*float32"):
    checkpoint.restore(tmp_path, 1, cast)
  with pytest.raises(ConfigError, match=r"uint8\[5, 2, 3\] at images.*uint8\[6"):
    checkpoint.restore(tmp_path, 1, _state(images=6))
  more = dataclasses.replace(state, params={**state.params, "new": jnp.zeros(2)})
  with pytest.raises(ConfigError, match=r"holds nothing at params/new"):
    checkpoint.restore(tmp_path, 1, more)
  with pytest.raises(ConfigError, match=r"at absent"):
    checkpoint.restore(tmp_path, 1, dataclasses.replace(state, absent=jnp.zeros(2)))


def test_missing_and_broken_checkpoints_are_refused_in_one_line(tmp_path: Path):
  assert checkpoint.latest_step(tmp_path) is None
  with pytest.raises(ConfigError, match="has no checkpoint"):
    checkpoint.restore(tmp_path, None, _state())
  _save(tmp_path, (1, _state(1), None), (2, _state(2), None))
  with pytest.raises(ConfigError, match="no checkpoint 3; choose from 1, 2"):
    checkpoint.restore(tmp_path, 3, _state())
  folder = tmp_path / "checkpoints"
  shutil.rmtree(folder / "2" / "state" / "d")
  with pytest.raises(ConfigError, match="checkpoint 2 of .* cannot be read") as error:
    checkpoint.restore(tmp_path, 2, _state())
  assert "\n" not in str(error.value)
  # What was cut off while being written is not taken for a checkpoint.
  (folder / "9.orbax-checkpoint-tmp").mkdir()
  assert checkpoint.all_steps(tmp_path) == [1, 2]
  _assert_same_bits(checkpoint.restore(tmp_path, 1, _state()), _state(1))


def test_another_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  _save(tmp_path, (1, _state(), None))
  monkeypatch.setattr(checkpoint, "SCHEMA_VERSION", checkpoint.SCHEMA_VERSION + 1)
  with pytest.raises(ConfigError, match="has format 1; this code reads 2"):
    checkpoint.restore(tmp_path, 1, _state())
