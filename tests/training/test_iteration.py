"""The training iteration: repeatable, resumable and robust against NaN.

One compiled iteration serves all tests. Non-finite values are put into real states. The
slow variants repeat everything for other algorithms, engines and observations.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from pathlib import Path
import shutil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import errors, testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.agents.table_one import ALGORITHMS, imitates
from apnpql_jax.cli import main
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.runs import (
  checkpoint_reader,
  checkpoint_record,
  leaves,
  run_folder,
  segments,
)
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume, skipped_updates
from apnpql_jax.training.expert import collect_expert, empty_expert
from apnpql_jax.training.iteration import make_iteration, make_sample
from apnpql_jax.training.state import TrainState, initial_expert, initial_state

WORLDS, LENGTH = testing.TINY.env.worlds, testing.TINY.rollout_length


class Built(NamedTuple):
  """Objects that are expensive to build."""

  config: TrainConfig
  env: Env
  iteration: Callable  # compiled; donates its argument
  state: TrainState  # after three iterations


def _variants() -> list[Any]:
  first, *others = ALGORITHMS
  variants = [(first, "native", "pixels", 0), (first, "mjx", "state", 0)]
  variants += [(name, "native", "state", 0) for name in others]
  variants += [(first, "native", "pixels", 3), ("svg_prior", "native", "state", 3)]
  slow = [
    pytest.param(v, marks=pytest.mark.slow, id="-".join(map(str, v))) for v in variants
  ]
  return [pytest.param((first, "native", "state", 0), id=first), *slow]


@pytest.fixture(scope="module", params=_variants())
def built(request) -> Built:
  algorithm, backend, obs, instants = request.param
  agent = dataclasses.replace(
    testing.TINY.agent, algorithm=algorithm, lstm_instants=instants
  )
  config = dataclasses.replace(
    testing.TINY,
    env=dataclasses.replace(testing.TINY.env, backend=backend, obs=obs),
    agent=agent,
    max_skipped_updates=2,
  )
  label_expert = imitates(config.agent)
  env = make_env(config.env, lstm_instants=instants, label_expert=label_expert)
  agent = make_agent(config.agent)
  state = initial_state(config, env, agent, collect_expert)
  assert all(x.committed for x in jax.tree.leaves(state))
  jitted: Any = make_iteration(config, env, agent)
  iteration = jitted.lower(state).compile()
  for _ in range(3):
    state, metrics = iteration(state)
  assert metrics["faults/worlds"] == metrics["faults/updates"] == 0
  return Built(config, env, iteration, state)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
  """Changes the folder: C MuJoCo writes a log there if a world is not finite."""
  monkeypatch.chdir(tmp_path)


@pytest.fixture
def iteration(built):
  """Returns the iteration on a copy of the state, so as not to donate the original."""
  return lambda state: built.iteration(jax.tree.map(jnp.copy, state))


@pytest.fixture
def state(built) -> TrainState:
  return built.state


def _bits(tree: Any) -> list[bytes]:
  keys = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)  # noqa: E731
  plain = jax.tree.map(lambda x: jax.random.key_data(x) if keys(x) else x, tree)
  return [np.asarray(x).tobytes() for x in jax.tree.leaves(plain)]


def _break_world(state: TrainState, field: str, value: float) -> TrainState:
  """Sets the first number of a physics field of world 1 to ``value``."""
  broken = getattr(state.env.physics, field).at[1, 0].set(value)
  physics = state.env.physics.replace(**{field: broken})
  return state.replace(env=state.env.replace(physics=physics))


def _poison_replay(state: TrainState) -> TrainState:
  """Sets the rewards of both replays to NaN."""

  def poison(ring: replay.Replay) -> replay.Replay:
    timestep = ring.slots.timestep
    timestep = timestep.replace(reward=timestep.reward * jnp.nan)
    return ring.replace(slots=ring.slots.replace(timestep=timestep))

  assert state.expert_replay is not None
  return state.replace(
    replay=poison(state.replay), expert_replay=poison(state.expert_replay)
  )


def _poison_learner(state: TrainState) -> TrainState:
  """Sets the primitives so far off that the gradient of their loss is NaN."""
  params = dict(state.learner.params)
  params["ap"] = jax.tree.map(lambda x: x + jnp.inf, params["ap"])
  return state.replace(learner=state.learner.replace(params=params))


def test_the_state_keeps_its_types_so_that_it_compiles_once(built):
  agent = make_agent(built.config.agent)
  start = jax.eval_shape(
    lambda: initial_state(built.config, built.env, agent, empty_expert)
  )
  after, _ = jax.eval_shape(make_iteration(built.config, built.env, agent), start)

  def types(state: TrainState) -> dict[str, tuple]:
    named = leaves.named(state)
    return {name: (x.shape, x.dtype, x.weak_type) for name, x in named.items()}

  assert types(start) == types(after)


def test_the_target_network_acts(iteration, state):
  """The next worlds depend on the target parameters, not on the trained ones."""

  def worlds(**learner: Any) -> list[bytes]:
    moved = state.replace(learner=state.learner.replace(**learner))
    return _bits(iteration(moved)[0].env)

  other = jax.tree.map(lambda x: x + 0.01, state.learner.params)
  assert worlds(params=other) == worlds()
  assert worlds(target_params=other) != worlds()


def test_an_iteration_is_a_function_of_its_state(iteration, state):
  first, again = iteration(state), iteration(state)
  assert _bits(first) == _bits(again)
  other = iteration(state.replace(key=jax.random.key(99)))
  assert _bits(other[0].learner) != _bits(first[0].learner)


def test_another_seed_is_another_run(built):
  agent = make_agent(built.config.agent)
  one, other = (
    initial_state(
      dataclasses.replace(built.config, seed=seed), built.env, agent, empty_expert
    )
    for seed in (0, 1)
  )
  for part in ("learner", "env", "key"):
    assert _bits(getattr(one, part)) != _bits(getattr(other, part))


def _save(run: Path, built: Built, *states: tuple[TrainState, bool]) -> None:
  with CheckpointWriter(run, built.config, keep=9) as writer:
    for state, whole in states:
      rings = resume.to_rings(state, chunk=LENGTH) if whole else {}
      items = resume.to_items(state, whole=whole)
      writer.save(int(state.env_steps), items, rings=rings)


def test_a_saved_state_continues_bit_for_bit(built, iteration, tmp_path):
  _save(tmp_path, built, (built.state, True))
  example = jax.eval_shape(lambda: jax.tree.map(jnp.copy, built.state))
  restored = resume.restore_run(built.config, tmp_path, example, pytest.fail).state
  straight = built.state
  # Otherwise the first resume would compile the iteration again.
  assert all(x.committed for x in jax.tree.leaves(restored))
  assert _bits(restored) == _bits(straight) and len(_bits(straight)) > 60
  for _ in range(2):
    straight, metrics = iteration(straight)
    restored, again = iteration(restored)
  assert _bits(restored) == _bits(straight) and _bits(metrics) == _bits(again)


def test_an_episode_excluded_after_it_was_saved_stays_excluded(built, tmp_path):
  before, steps = built.state, jnp.full(WORLDS, 2 * LENGTH)
  ring = replay.exclude(before.replay, steps)
  after = before.replace(replay=ring, env_steps=before.env_steps + 1)
  assert _bits(ring) != _bits(before.replay)
  _save(tmp_path, built, (before, True), (after, True))
  old, new = checkpoint_record.read_all(tmp_path).values()
  assert old.segments == new.segments and old.segments
  example = jax.eval_shape(lambda: jax.tree.map(jnp.copy, after))
  restored = resume.restore_run(built.config, tmp_path, example, pytest.fail).state
  assert _bits(restored) == _bits(after)


def test_a_state_saved_without_replay_continues_with_an_older_one(
  built, iteration, tmp_path
):
  before, after = built.state, iteration(built.state)[0]
  _save(tmp_path, built, (before, True), (after, False))
  assert checkpoint_reader.all_steps(tmp_path) == [24, 32]
  example = jax.eval_shape(lambda: jax.tree.map(jnp.copy, after))
  warnings: list[str] = []
  restored = resume.restore_run(built.config, tmp_path, example, warnings.append).state
  assert warnings == ["its replay comes from step 24"]
  assert _bits(restored.replace(replay=None)) == _bits(after.replace(replay=None))
  assert int(restored.replay.cursor) == int(before.replay.cursor)
  # The next slots do not continue the newest one, which is now marked as an end.
  held, kept = (x.replay.slots.timestep.truncated for x in (restored, before))
  newest = int(before.replay.cursor) - 1
  assert held[newest].all() and not kept[newest].any()
  np.testing.assert_array_equal(held[:newest], kept[:newest])
  assert jnp.isfinite(iteration(restored)[1]["loss/q"])


def _damage(run: Path, state: TrainState, ring: str, start: int) -> None:
  """Removes the segment of a ring that begins at time index ``start``."""
  record = checkpoint_record.read(run, int(state.env_steps))
  (found,) = (x for x in record.segments if (x.ring, x.start) == (ring, start))
  shutil.rmtree(segments.folder(run) / str(found.number))


def test_slots_of_a_damaged_segment_are_never_drawn(
  built, iteration, tmp_path, monkeypatch
):
  ring = built.state.replay.slots
  rows = sum(x.nbytes for x in jax.tree.leaves(ring)) // len(ring.action)
  monkeypatch.setattr(segments, "PART_BYTES", 2 * rows)
  _save(tmp_path, built, (built.state, True))
  for name in ("agent", "expert"):
    _damage(tmp_path, built.state, name, 2)
  example = jax.eval_shape(lambda: jax.tree.map(jnp.copy, built.state))
  warnings: list[str] = []
  restored, intact = resume.restore_run(
    built.config, tmp_path, example, warnings.append
  )
  assert not intact and warnings == [
    "8 slots of the replay are damaged and left out",
    "8 slots of the expert replay are damaged and left out",
  ]
  for held, kept in (
    (restored.replay, built.state.replay),
    (restored.expert_replay, built.state.expert_replay),
  ):
    assert held is not None and kept is not None
    gone = held.slots.timestep.truncated & ~kept.slots.timestep.truncated
    np.testing.assert_array_equal(np.flatnonzero(gone.any(1)), [1, 2, 3])
    # What is lost is zeros; nothing of it is in any transition.
    assert not held.slots.action[2:4].any() and kept.slots.action[2:4].any()
    batch = replay.sample(held, jax.random.key(0), batch_size=512, n_step=2, gamma=0.9)
    assert 0 < batch.weight.sum() and batch.primitives_tm1[:, 0].any(1).all()
    assert batch.observation_t.robot.any(1).all()
  assert jnp.isfinite(iteration(restored)[1]["loss/q"])
  # The next checkpoint is whole.
  rings = resume.to_rings(restored, chunk=LENGTH)
  with CheckpointWriter(tmp_path, built.config, keep=9) as writer:
    later = restored.replace(env_steps=restored.env_steps + 1)
    writer.save(int(later.env_steps), resume.to_items(later, whole=True), rings=rings)
  again = resume.restore_run(built.config, tmp_path, example, pytest.fail)
  assert again.intact and _bits(again.state) == _bits(later)


def test_a_damaged_expert_replay_is_filled_again(built, tmp_path):
  """It is the same, because it depends on the seed alone."""
  _save(tmp_path, built, (built.state, True))
  _damage(tmp_path, built.state, "expert", 0)
  example = jax.eval_shape(lambda: jax.tree.map(jnp.copy, built.state))
  warnings: list[str] = []
  restored, intact = resume.restore_run(
    built.config,
    tmp_path,
    example,
    warnings.append,
    refill=lambda: initial_expert(built.config, built.env, collect_expert),
  )
  assert not intact and warnings == ["the expert replay is damaged and filled again"]
  assert _bits(restored) == _bits(built.state)

  def gone() -> None:
    raise FileError("demos.npz is gone")

  words = r"expert replay is damaged .*\(demos.npz is gone\); nothing of it is left"
  with pytest.raises(FileError, match=words):
    resume.restore_run(built.config, tmp_path, example, warnings.append, refill=gone)


@pytest.mark.parametrize(
  ("field", "value"),
  [("qpos", np.nan), ("qvel", np.inf), ("qvel", 1e12), ("qacc_warmstart", np.nan)],
)
def test_a_broken_world_restarts_and_its_episode_is_never_drawn(
  built, iteration, state, field, value
):
  after, metrics = iteration(_break_world(state, field, value))
  clean, _ = iteration(state)
  assert metrics["faults/worlds"] == 1
  np.testing.assert_array_equal(after.env.faults, [0, 1, 0, 0])
  assert after.env.elapsed[1] < LENGTH
  for leaf in jax.tree.leaves((after.env.physics, after.learner)):
    assert jnp.isfinite(leaf).all()
  # All slots of its episode, from 3 iterations and this one, are marked as ends.
  cursor, length = int(after.replay.cursor), after.replay.slots.action.shape[0]
  newest = (cursor - 1 - np.arange(4 * LENGTH)) % length
  truncated = np.asarray(after.replay.slots.timestep.truncated)
  assert truncated[newest, 1].all() and not truncated[newest][:, [0, 2, 3]].any()
  # The other worlds are as they would have been.
  others = np.array([0, 2, 3])
  np.testing.assert_array_equal(
    after.env.physics.qpos[others], clean.env.physics.qpos[others]
  )
  keys = jax.random.split(jax.random.key(0), 64)
  sample = jax.jit(make_sample(built.config, make_agent(built.config.agent)))
  for key in keys:
    batch = sample(after.replay, after.expert_replay, key)
    drawn = jax.tree.leaves((batch.observation_tm1, batch.observation_t))
    assert all(jnp.isfinite(x).all() for x in drawn)
    robot = np.asarray(after.replay.slots.timestep.observation.robot)[newest, 1]
    # With an LSTM a start is a window of instants.
    starts = np.asarray(batch.observation_tm1.robot)[batch.weight > 0]
    starts = starts.reshape(-1, robot.shape[-1])
    assert not (starts[:, None, :] == robot[None]).all(-1).any()


def test_a_world_that_breaks_in_its_first_period_is_found(built, iteration, state):
  """C MuJoCo resets such a world; its clock must not pass for a first period."""
  fresh = built.env.reset(jnp.arange(WORLDS))
  poisoned = _break_world(state.replace(env=fresh), "qvel", 1e12)
  after, metrics = iteration(poisoned)
  assert metrics["faults/worlds"] == 1
  np.testing.assert_array_equal(after.env.faults, [0, 1, 0, 0])


def test_the_native_engine_alone_hides_faults(built, state):
  """C MuJoCo continues from its default pose, finite, and ignores a NaN action."""
  if built.env.physics.name != "native":
    pytest.skip("MJX continues with NaN")
  step, sound = built.env.physics.step, built.env._sound
  action = jnp.zeros((WORLDS, 7))
  broken = _break_world(state, "qpos", np.nan).env
  moved = step(broken.physics, action[:, :6], action[:, 6])
  assert jnp.isfinite(moved.qpos).all()
  np.testing.assert_array_equal(sound(broken, action, moved), [True, False, True, True])
  action = action.at[2, 3].set(jnp.nan)
  moved = step(state.env.physics, action[:, :6], action[:, 6])
  assert jnp.isfinite(moved.qpos).all()
  sound = sound(state.env, action, moved)
  np.testing.assert_array_equal(sound, [True, True, False, True])


@pytest.mark.parametrize("poison", [_poison_replay, _poison_learner])
def test_a_non_finite_update_is_skipped_and_counted(iteration, state, poison):
  poisoned = poison(state)
  after, metrics = iteration(poisoned)
  assert metrics["faults/updates"] == metrics["faults/updates_in_a_row"] == 2
  assert _bits(after.learner) == _bits(poisoned.learner)
  assert jnp.isnan(metrics["loss/q"])  # No update, so no loss.
  healed, metrics = iteration(
    after.replace(
      replay=state.replay, expert_replay=state.expert_replay, learner=state.learner
    )
  )
  assert metrics["faults/updates"] == metrics["faults/updates_in_a_row"] == 0
  assert int(healed.learner.step) == int(state.learner.step) + 2
  assert jnp.isfinite(metrics["loss/q"])


def test_after_several_skipped_updates_the_run_stops_and_they_can_be_repeated(
  built, iteration, state, tmp_path: Path, capsys
):
  run = run_folder.create(tmp_path / "run", built.config).path
  skipped_updates.check(built.config, state, run)
  assert not (run / "faults").exists()
  after, _ = iteration(_poison_replay(state))
  with pytest.raises(errors.RunStopped, match="2 consecutive updates") as stop:
    skipped_updates.check(built.config, after, run)
  assert stop.value.code == errors.FAILED
  (file,) = (run / "faults").iterdir()
  # The message ends with a command that works verbatim.
  command = str(stop.value).rpartition("apnpql ")[2].split()
  capsys.readouterr()
  assert main.main(command) == 0
  lines = capsys.readouterr().out.splitlines()
  assert [line.split()[0] for line in lines if "reward_t" in line] == ["batch"]
  # With zero rewards, also in windows, the same update is finite.
  arrays: dict[str, Any] = dict(np.load(file, allow_pickle=False))
  zeros = {k: np.zeros_like(x) for k, x in arrays.items() if "/reward" in k}
  np.savez(file, **(arrays | zeros))
  assert not any(skipped_updates.repeat(file).values())
  np.savez(file, **{k: v for k, v in arrays.items() if k != "key"})
  with pytest.raises(UserError, match="not an update of this run: 'key'"):
    skipped_updates.repeat(file)
