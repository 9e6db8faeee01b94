"""Replay against a numpy loop over the same stream, which knows nothing of rings."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import functools
from typing import Any

from hypothesis import given, settings, strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from apnpql_jax import devices
from apnpql_jax.data import replay as rb
from apnpql_jax.errors import UserError
from apnpql_jax.runs import leaves
from apnpql_jax.types import Observation, Slot, TimeStep, Transition

GAMMA = 0.9
WORLDS = 2


def _example(pixels: int = 2) -> Slot:
  spec: Any = jax.ShapeDtypeStruct
  observation = Observation(
    robot=spec((2,), jnp.float32), global_image=spec((pixels, 3, 3), jnp.uint8)
  )
  timestep = TimeStep(
    observation=observation,
    reward=spec((), jnp.float32),
    terminated=spec((), jnp.bool_),
    truncated=spec((), jnp.bool_),
    primitives=spec((3, 7), jnp.float32),
  )
  return Slot(
    timestep=timestep, action=spec((7,), jnp.float32), log_prob=spec((), jnp.float32)
  )


def _stream(steps: int, worlds: int, end_rate: float, seed: int) -> Slot:
  """Draws slots [steps, worlds]; the robot state is the slot's (time, world)."""
  rng: Any = np.random.default_rng(seed)
  end: Any = rng.random((steps, worlds)) < end_rate
  terminated = end & (rng.random((steps, worlds)) < 0.5)
  time, world = np.meshgrid(np.arange(steps), np.arange(worlds), indexing="ij")
  robot: Any = np.stack([time, world], axis=-1).astype(np.float32)
  image: Any = np.broadcast_to(
    (time * 7 + world * 31)[..., None, None, None], (steps, worlds, 2, 3, 3)
  )
  timestep = TimeStep(
    observation=Observation(robot=robot, global_image=image.astype(np.uint8)),
    reward=rng.normal(size=(steps, worlds)).astype(np.float32),
    terminated=terminated,
    truncated=end & ~terminated,
    primitives=rng.normal(size=(steps, worlds, 3, 7)).astype(np.float32),
  )
  action = rng.normal(size=(steps, worlds, 7)).astype(np.float32)
  log_prob = rng.normal(size=(steps, worlds)).astype(np.float32)
  return Slot(timestep=timestep, action=action, log_prob=log_prob)


def _image(observation: Observation) -> Any:
  return observation.global_image


def _fill(stream: Slot, length: int, chunk: int) -> rb.Replay:
  steps, worlds = stream.action.shape[:2]
  add = jax.jit(rb.add, donate_argnums=0)
  replay = rb.create(_example(), length, worlds)
  for start in range(0, steps, chunk):
    part = jax.tree.map(lambda x, s=start: jnp.asarray(x[s : s + chunk]), stream)
    replay = add(replay, part)
  return replay


@functools.partial(jax.jit, static_argnames=("batch_size", "n_step"))
def _sample(
  replay: rb.Replay, key: jax.Array, batch_size: int, n_step: int
) -> Transition:
  return rb.sample(replay, key, batch_size=batch_size, n_step=n_step, gamma=GAMMA)


def _n_step(step: TimeStep, t: int, w: int, n_step: int) -> tuple[float, float, int]:
  """Walks the stream from slot t: (sum of rewards, discount, slot to bootstrap)."""
  total, discount = 0.0, 1.0
  for k in range(1, n_step + 1):
    total += discount * float(step.reward[t + k, w])
    discount *= GAMMA
    if step.terminated[t + k, w]:
      return total, 0.0, t + k
    if step.truncated[t + k, w]:
      return total, discount, t + k
  return total, discount, t + n_step


def _valid_starts(step: TimeStep, length: int, n_step: int) -> set[tuple[int, int]]:
  last = step.terminated | step.truncated
  steps, worlds = last.shape
  times = range(max(0, steps - length), steps - n_step)
  return {(t, w) for t in times for w in range(worlds) if not last[t, w]}


@settings(max_examples=40, deadline=None)
@given(
  chunk=st.sampled_from([1, 2, 4]),
  chunks=st.integers(1, 14),
  n_step=st.sampled_from([1, 3]),
  end_rate=st.sampled_from([0.0, 0.1, 0.4]),
  seed=st.integers(0, 2**31 - 1),
)
def test_transitions_equal_those_of_a_loop_over_the_stream(
  chunk: int, chunks: int, n_step: int, end_rate: float, seed: int
):
  length = 12  # Fourteen chunks of four go around it more than four times.
  stream = _stream(chunk * chunks, WORLDS, end_rate, seed)
  replay = _fill(stream, length, chunk)
  batch = jax.device_get(_sample(replay, jax.random.key(seed), 16, n_step))
  step, valid = stream.timestep, _valid_starts(stream.timestep, length, n_step)
  assert bool(rb.can_sample(replay, n_step=n_step)) == (
    min(length, chunk * chunks) > n_step
  )
  if not valid:
    assert not batch.weight.any()
  for i in np.flatnonzero(batch.weight):
    t, w = batch.observation_tm1.robot[i].astype(int)
    assert (t, w) in valid
    total, discount, end = _n_step(step, t, w, n_step)
    np.testing.assert_allclose(batch.reward_t[i], total, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(batch.discount_t[i], discount, rtol=1e-6)
    np.testing.assert_array_equal(batch.observation_t.robot[i], (end, w))
    np.testing.assert_array_equal(batch.action_tm1[i], stream.action[t, w])
    np.testing.assert_array_equal(batch.primitives_tm1[i], step.primitives[t, w])
    images = _image(step.observation)
    np.testing.assert_array_equal(_image(batch.observation_tm1)[i], images[t, w])
    np.testing.assert_array_equal(_image(batch.observation_t)[i], images[end, w])


@pytest.mark.parametrize("n_step", [1, 3, 5])
def test_no_transition_leaves_its_episode(n_step: int):
  stream = _stream(48, WORLDS, 0.2, seed=3)
  last = stream.timestep.terminated | stream.timestep.truncated
  # Episode number of a slot: ends seen before it. A last slot is still its own.
  episode = np.cumsum(last, axis=0) - last
  replay = _fill(stream, length=32, chunk=8)
  batch = jax.device_get(_sample(replay, jax.random.key(0), 512, n_step))
  t, w = batch.observation_tm1.robot.astype(int).T
  t_next, w_next = batch.observation_t.robot.astype(int).T
  assert batch.weight.all() and (w == w_next).all()
  assert (episode[t, w] == episode[t_next, w]).all()
  # The early stop is exercised, and nothing older than the ring is seen.
  assert (t_next - t).min() >= 1 and (t_next - t).max() == n_step
  assert t.min() >= 16 and t_next.max() <= 47


def _until_end(step: TimeStep, t: int, w: int, n_step: int) -> list[int]:
  """Returns the slots 1 to N after t; from the first end on, only that one."""
  slots = []
  for _ in range(n_step):
    t += not slots or not (step.terminated[t, w] or step.truncated[t, w])
    slots.append(t)
  return slots


def test_windows_are_the_slots_after_the_start_across_the_seam():
  stream = _stream(48, WORLDS, 0.2, seed=4)
  replay = _fill(stream, length=32, chunk=16)  # Newest and oldest slot are neighbors.
  draw = functools.partial(rb.sample, replay, jax.random.key(0))
  draw = functools.partial(draw, batch_size=64, n_step=4, gamma=GAMMA)
  batch = jax.device_get(draw(windows=True))
  t, w = batch.observation_tm1.robot.astype(int).T
  after = np.array(
    [_until_end(stream.timestep, *start, 4) for start in zip(t, w, strict=True)]
  )
  expected = jax.tree.map(lambda x: x[after, w[:, None]], stream)
  jax.tree.map(np.testing.assert_array_equal, batch.window, expected)
  # Nothing else is drawn otherwise.
  without = jax.device_get(draw())
  assert without.window is None
  jax.tree.map(np.testing.assert_array_equal, without, batch.replace(window=None))


def _up_to(step: TimeStep, t: int, w: int, instants: int) -> list[int]:
  """Returns the last slots of an episode up to t; the first one fills the others."""
  slots = [t]
  while len(slots) < instants:
    t -= not (step.terminated[t - 1, w] or step.truncated[t - 1, w])
    slots.insert(0, t)
  return slots


@pytest.mark.parametrize("instants", [1, 4])
def test_observations_of_several_instants_are_of_one_episode(instants: int):
  stream = _stream(48, WORLDS, 0.2, seed=4)
  step = stream.timestep
  replay = _fill(stream, length=32, chunk=16)  # Newest and oldest slot are neighbors.
  batch = jax.device_get(
    rb.sample(
      replay,
      jax.random.key(0),
      batch_size=1000,
      n_step=3,
      gamma=GAMMA,
      windows=True,
      lstm_instants=instants,
    )
  )
  starts = batch.observation_tm1.robot[:, -1].astype(int)
  # What the oldest slots follow on has been overwritten.
  valid = {(t, w) for t, w in _valid_starts(step, 32, 3) if t >= 16 + instants - 1}
  assert {tuple(start) for start in starts} == valid
  w = starts[:, 1]
  np.testing.assert_array_equal(batch.action_tm1, stream.action[starts[:, 0], w])
  after = batch.window.timestep.observation
  assert after.robot.shape == (1000, 3, instants, 2)
  np.testing.assert_array_equal(after.robot[:, -1], batch.observation_t.robot)
  for seen in (batch.observation_tm1, batch.observation_t):
    t = seen.robot[:, -1, 0].astype(int)
    past = np.array([_up_to(step, *slot, instants) for slot in zip(t, w, strict=True)])
    expected = jax.tree.map(lambda x, t=past: x[t, w[:, None]], step.observation)
    jax.tree.map(np.testing.assert_array_equal, seen, expected)
  for k, t in enumerate(np.moveaxis(after.robot[:, :, -1, 0], 1, 0).astype(int)):
    past = np.array([_up_to(step, *slot, instants) for slot in zip(t, w, strict=True)])
    np.testing.assert_array_equal(after.robot[:, k, :, 0], past)


def test_neither_transition_nor_window_reaches_an_excluded_episode():
  """One world: an episode of six slots, then one that breaks and is not numbers."""
  stream = _stream(12, 1, 0.0, seed=0)
  end, broken = np.arange(12)[:, None] == 5, np.arange(12) > 5
  step = dataclasses.replace(stream.timestep, truncated=end)
  stream = dataclasses.replace(stream, timestep=step)
  for leaf in (step.observation.robot, step.reward, stream.action, stream.log_prob):
    leaf[broken] = np.nan
  ring = rb.exclude(_fill(stream, length=12, chunk=4), jnp.array([6]))
  batch = jax.device_get(
    rb.sample(
      ring, jax.random.key(0), batch_size=64, n_step=4, gamma=GAMMA, windows=True
    )
  )
  drawn = batch.weight > 0
  assert set(batch.observation_tm1.robot[drawn, 0]) == set(range(5))
  for leaf in jax.tree.leaves(batch):
    assert np.isfinite(leaf[drawn]).all()


def test_episodes_are_counted_at_their_ends():
  """World 0 solves two episodes and times out in one; that of world 1 is excluded."""
  assert _counted(excluded=5) == [2, 4]


def test_an_excluded_episode_after_an_end_counts_with_it():
  assert _counted(excluded=5, ends=[6]) == [2, 4]
  assert _counted(excluded=5, ends=[2, 6]) == [2, 5]
  assert _counted(excluded=12) == [2, 3]


def _counted(excluded: int, ends: Sequence[int] = ()) -> list[int]:
  """Counts successes and ends; world 1 times out at ``ends``, then excludes slots."""
  stream = _stream(12, WORLDS, end_rate=0.0, seed=0)
  stream.timestep.terminated[[2, 9], 0] = True
  stream.timestep.truncated[6, 0] = True
  stream.timestep.truncated[list(ends), 1] = True
  replay = rb.exclude(_fill(stream, length=12, chunk=4), jnp.asarray([0, excluded]))
  return [int(x) for x in rb.episodes(replay)]


def test_rewards_worked_by_hand():
  stream = _stream(6, 1, 0.0, seed=0)
  step = dataclasses.replace(
    stream.timestep,
    reward=np.array([9, 1, 2, 4, 8, 16], np.float32)[:, None],
    terminated=np.array([0, 0, 0, 1, 0, 0], bool)[:, None],
    truncated=np.zeros((6, 1), bool),
  )
  replay = _fill(dataclasses.replace(stream, timestep=step), length=6, chunk=6)
  batch = jax.device_get(_sample(replay, jax.random.key(1), 64, 2))
  # Slot 3 is last. From 1: 2 + .9 * 4, ended. From 2: 4, ended.
  expected = {0: (2.8, 0.81), 1: (5.6, 0.0), 2: (4.0, 0.0)}
  starts = batch.observation_tm1.robot[:, 0].astype(int)
  assert set(starts) == {0, 1, 2}
  for i, t in enumerate(starts):
    got = (batch.reward_t[i], batch.discount_t[i])
    np.testing.assert_allclose(got, expected[t], rtol=1e-6)


def test_truncation_bootstraps_and_termination_wins_over_it():
  for terminated, discount in ((False, GAMMA), (True, 0.0)):
    stream = _stream(4, 1, 0.0, seed=0)
    end = np.array([0, 1, 0, 0], bool)[:, None]
    step = dataclasses.replace(
      stream.timestep, truncated=end, terminated=end & terminated
    )
    replay = _fill(dataclasses.replace(stream, timestep=step), length=4, chunk=4)
    batch = jax.device_get(_sample(replay, jax.random.key(0), 8, 3))
    assert (batch.observation_tm1.robot[:, 0] == 0).all()
    np.testing.assert_allclose(batch.discount_t, discount, rtol=1e-6)


def test_draws_are_uniform_over_valid_starts():
  n_step, length = 3, 20
  stream = _stream(28, WORLDS, 0.3, seed=11)
  replay = _fill(stream, length, chunk=4)
  batch = jax.device_get(_sample(replay, jax.random.key(5), 100_000, n_step))
  assert batch.weight.all()
  valid = _valid_starts(stream.timestep, length, n_step)
  drawn, counts = np.unique(
    batch.observation_tm1.robot.astype(int), axis=0, return_counts=True
  )
  assert {tuple(row) for row in drawn} == valid
  # A uniform draw fails this for one key in 10 000 and the key is fixed; at this
  # size, one start drawn 10 % too often would bring p near 1e-5.
  assert stats.chisquare(counts).pvalue > 1e-4


def test_small_batches_are_uniform_too():
  # Batches of one, where refused candidates matter most: half of all slots end.
  stream = _stream(16, WORLDS, 0.5, seed=4)
  replay = _fill(stream, length=16, chunk=16)
  draw = jax.jit(jax.vmap(lambda key: _sample(replay, key, 1, 1)))
  batch = jax.device_get(draw(jax.random.split(jax.random.key(2), 8_000)))
  kept = batch.weight[:, 0] > 0
  starts = batch.observation_tm1.robot[kept, 0].astype(int)
  drawn, counts = np.unique(starts, axis=0, return_counts=True)
  assert {tuple(row) for row in drawn} == _valid_starts(stream.timestep, 16, 1)
  assert stats.chisquare(counts).pvalue > 1e-4


def test_dtypes_and_bytes_are_those_of_the_slots():
  replay = _fill(_stream(8, WORLDS, 0.2, seed=0), length=8, chunk=4)
  assert _image(replay.slots.timestep.observation).dtype == jnp.uint8
  assert replay.slots.timestep.terminated.dtype == jnp.bool_
  batch = _sample(replay, jax.random.key(0), 4, 3)
  assert _image(batch.observation_t).dtype == jnp.uint8
  assert _image(batch.observation_t).shape == (4, 2, 3, 3)
  slot = 2 * 3 * 3 + 4 * (2 + 1 + 21 + 7 + 1) + 2
  held = sum(leaf.nbytes for leaf in jax.tree.leaves(replay))
  assert held == 8 * WORLDS * slot + 8


def test_one_key_gives_one_batch():
  replay = _fill(_stream(24, WORLDS, 0.2, seed=8), length=16, chunk=8)
  first = _sample(replay, jax.random.key(3), 32, 3)
  again = _sample(replay, jax.random.key(3), 32, 3)
  other = _sample(replay, jax.random.key(4), 32, 3)
  jax.tree.map(np.testing.assert_array_equal, first, again)
  assert not np.array_equal(first.observation_tm1.robot, other.observation_tm1.robot)


@pytest.mark.parametrize(("share", "experts"), [(0.25, 4), (0.0, 0), (1.0, 16)])
def test_expert_share_is_exact(share: float, experts: int):
  agent = _fill(_stream(16, WORLDS, 0.2, seed=1), length=16, chunk=8)
  stream = _stream(16, WORLDS, 0.2, seed=2)
  stream.timestep.observation.robot[...] += 1000.0
  expert = _fill(stream, length=16, chunk=8)
  sample = functools.partial(
    rb.sample_mixed, batch_size=16, expert_share=share, n_step=3, gamma=GAMMA
  )
  for seed in range(5):
    batch = jax.device_get(
      jax.jit(sample)(agent, expert if experts else None, jax.random.key(seed))
    )
    is_expert = batch.observation_tm1.robot[:, 0] >= 1000.0
    assert is_expert[16 - experts :].all() and int(is_expert.sum()) == experts
    assert batch.weight.all() and batch.weight.shape == (16,)


def test_empty_agent_replay_has_no_weight_and_keeps_the_share():
  expert = _fill(_stream(16, WORLDS, 0.1, seed=2), length=16, chunk=8)
  sample = functools.partial(
    rb.sample_mixed, batch_size=8, expert_share=0.5, n_step=3, gamma=GAMMA
  )
  empty = rb.create(_example(), 16, WORLDS)
  batch = jax.jit(sample)(empty, expert, jax.random.key(0))
  np.testing.assert_array_equal(batch.weight, [0, 0, 0, 0, 1, 1, 1, 1])
  with pytest.raises(ValueError, match="needs an expert replay"):
    sample(expert, None, jax.random.key(0))


def test_chunks_that_do_not_fit_are_refused_when_traced():
  replay = rb.create(_example(), 12, WORLDS)
  with pytest.raises(ValueError, match="5 instants does not divide a ring of 12"):
    jax.eval_shape(rb.add, replay, _stream(5, WORLDS, 0.1, seed=0))
  with pytest.raises(ValueError, match="the ring takes"):
    jax.eval_shape(rb.add, replay, _stream(4, WORLDS + 1, 0.1, seed=0))
  wrong = _stream(4, WORLDS, 0.1, seed=0)
  wrong = dataclasses.replace(wrong, action=wrong.action.astype(np.float16))
  with pytest.raises(ValueError, match="float16"):
    jax.eval_shape(rb.add, replay, wrong)


def test_an_iteration_of_add_and_samples_copies_no_ring():
  # Compiled only, never run: the ring is not allocated. A copy shows as temporaries.
  length, example = 1024, _example(pixels=3000)
  replay = jax.eval_shape(lambda: rb.create(example, length, WORLDS))
  ring_bytes = leaves.nbytes(replay)
  chunk = jax.tree.map(
    lambda x: jax.ShapeDtypeStruct((4, *x.shape[1:]), x.dtype), replay.slots
  )

  def iteration(replay, chunk, key):
    replay = rb.add(replay, chunk)

    def update(total, key):
      batch = rb.sample_mixed(
        replay, replay, key, batch_size=4, expert_share=0.5, n_step=3, gamma=GAMMA
      )
      return total + jnp.sum(_image(batch.observation_t), dtype=jnp.int32), None

    total, _ = jax.lax.scan(update, jnp.int32(0), jax.random.split(key, 3))
    return replay, total

  compiled = jax.jit(iteration, donate_argnums=0).lower(
    replay, chunk, jax.random.key(0)
  )
  usage: Any = compiled.compile().memory_analysis()
  assert usage.alias_size_in_bytes >= 0.99 * ring_bytes
  assert usage.temp_size_in_bytes < 0.05 * ring_bytes


def test_add_writes_into_the_donated_buffer():
  replay = rb.create(_example(), 8, WORLDS)
  address = _image(replay.slots.timestep.observation).unsafe_buffer_pointer()
  chunk = jax.tree.map(jnp.asarray, _stream(4, WORLDS, 0.1, seed=0))
  replay = jax.jit(rb.add, donate_argnums=0)(replay, chunk)
  after = _image(replay.slots.timestep.observation).unsafe_buffer_pointer()
  assert after == address


def test_a_ring_larger_than_memory_is_refused_in_one_line():
  ring = jax.eval_shape(lambda: rb.create(_example(pixels=72 * 96), 10**7, 1000))
  needed = leaves.nbytes(ring)
  with pytest.raises(UserError, match=r"replay needs .* GiB .*replay.capacity") as e:
    devices.check_memory(needed, "the agent replay")
  assert "\n" not in str(e.value)
  devices.check_memory(1000, "the agent replay")
  devices.check_memory(1000, "the agent replay", available=1000)
  with pytest.raises(UserError):
    devices.check_memory(1001, "the agent replay", available=1000)


def test_available_memory_is_plausible():
  available = devices.available_memory()
  assert available is not None and 2**26 < available < 2**50
