"""Values that are not finite, put into real states of a real run, and what comes of it.

One compiled iteration serves all tests of this file.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from apnpql_jax import cli, faults, replay, run_folder, runs
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config import ConfigError
from apnpql_jax.env import Env, make_env
from apnpql_jax.iteration import TrainState, initial_state, make_iteration, make_sample

CONFIG = dataclasses.replace(tiny.CONFIG, max_skipped_updates=2)
WORLDS, LENGTH = CONFIG.env.worlds, CONFIG.rollout_length


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG.env)


@pytest.fixture(scope="module")
def built(env) -> tuple[Any, TrainState]:
  """The compiled iteration, and the state after three of them."""
  agent = make_agent(CONFIG.agent)
  state = initial_state(CONFIG, env, agent)
  jitted: Any = make_iteration(CONFIG, env, agent)
  iteration = jitted.lower(state).compile(compiler_options=tiny.FAST_COMPILE)
  for _ in range(3):
    state, metrics = iteration(state)
  assert metrics["faults/worlds"] == metrics["faults/updates"] == 0
  return iteration, state


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
  """C MuJoCo writes a log into the present folder when a world is not finite."""
  monkeypatch.chdir(tmp_path)


@pytest.fixture
def iteration(built):
  """The iteration on a copy: it donates its argument."""
  return lambda state: built[0](jax.tree.map(jnp.copy, state))


@pytest.fixture
def state(built) -> TrainState:
  return built[1]


def _bits(tree: Any) -> list[bytes]:
  return [np.asarray(x).tobytes() for x in jax.tree.leaves(tree)]


def _break_world(state: TrainState, field: str, value: float) -> TrainState:
  """World 1 with ``value`` in the first number of a field of its physics."""
  broken = getattr(state.env.physics, field).at[1, 0].set(value)
  physics = state.env.physics.replace(**{field: broken})
  return state.replace(env=state.env.replace(physics=physics))


def _poison_replay(state: TrainState) -> TrainState:
  """Rewards of both replays that are not numbers."""

  def poison(ring: replay.Replay) -> replay.Replay:
    timestep = ring.slots.timestep
    timestep = timestep.replace(reward=timestep.reward * jnp.nan)
    return ring.replace(slots=ring.slots.replace(timestep=timestep))

  assert state.expert_replay is not None
  return state.replace(
    replay=poison(state.replay), expert_replay=poison(state.expert_replay)
  )


def _poison_learner(state: TrainState) -> TrainState:
  """Primitives so far off that the gradient of their loss is not a number."""
  params = dict(state.learner.params)
  params["ap"] = jax.tree.map(lambda x: x + jnp.inf, params["ap"])
  return state.replace(learner=state.learner.replace(params=params))


def test_an_iteration_is_a_function_of_its_state(iteration, state):
  first, again = iteration(state), iteration(state)
  keys = [jax.random.key_data(out[0].key).tobytes() for out in (first, again)]
  assert keys[0] == keys[1]
  plain = [out[0].replace(key=0, faults=0) for out in (first, again)]
  assert _bits(plain[0]) == _bits(plain[1]) and _bits(first[1]) == _bits(again[1])
  other = iteration(state.replace(key=jax.random.key(99)))[0]
  assert _bits(other.learner) != _bits(first[0].learner)


@pytest.mark.parametrize(
  ("field", "value"),
  [("qpos", np.nan), ("qvel", np.inf), ("qvel", 1e12), ("qacc_warmstart", np.nan)],
)
def test_a_broken_world_starts_again_and_its_episode_is_never_drawn(
  iteration, state, field, value
):
  after, metrics = iteration(_break_world(state, field, value))
  clean, _ = iteration(state)
  assert metrics["faults/worlds"] == 1
  np.testing.assert_array_equal(after.env.faults, [0, 1, 0, 0])
  assert after.env.elapsed[1] < LENGTH
  for leaf in jax.tree.leaves((after.env.physics, after.learner)):
    assert jnp.isfinite(leaf).all()
  # The instants of its episode, 3 iterations and this one, are all marked as ends.
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
  sample = jax.jit(make_sample(CONFIG))
  for key in keys:
    batch = sample(after.replay, after.expert_replay, key)
    drawn = jax.tree.leaves((batch.observation_tm1, batch.observation_t))
    assert all(jnp.isfinite(x).all() for x in drawn)
    robot = np.asarray(after.replay.slots.timestep.observation.robot)[newest, 1]
    starts = np.asarray(batch.observation_tm1.robot)[batch.weight > 0]
    assert not (starts[:, None, :] == robot[None]).all(-1).any()


def test_the_engine_alone_would_not_have_told(env, state):
  """C MuJoCo goes on from its default pose, finite, when a world is not."""
  broken = _break_world(state, "qpos", np.nan).env.physics
  moved = env.physics.step(broken, jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS))
  assert jnp.isfinite(moved.qpos).all()


def test_an_action_that_is_not_finite_breaks_its_world(env, state):
  action = jnp.zeros((WORLDS, 7)).at[2, 3].set(jnp.nan)
  moved = env.physics.step(state.env.physics, action[:, :6], action[:, 6])
  # The engine takes it for no torque at all.
  assert jnp.isfinite(moved.qpos).all()
  sound = env._sound(state.env, action, moved)
  np.testing.assert_array_equal(sound, [True, True, False, True])


@pytest.mark.parametrize("poison", [_poison_replay, _poison_learner])
def test_an_update_that_is_not_finite_is_skipped_and_counted(iteration, state, poison):
  poisoned = poison(state)
  after, metrics = iteration(poisoned)
  assert metrics["faults/updates"] == metrics["faults/updates_in_a_row"] == 2
  assert _bits(after.learner) == _bits(poisoned.learner)
  assert jnp.isnan(metrics["loss/q"])  # There was no update whose loss it could be.
  healed, metrics = iteration(
    after.replace(
      replay=state.replay, expert_replay=state.expert_replay, learner=state.learner
    )
  )
  assert metrics["faults/updates"] == metrics["faults/updates_in_a_row"] == 0
  assert int(healed.learner.step) == int(state.learner.step) + 2
  assert jnp.isfinite(metrics["loss/q"])


def test_after_several_the_run_stops_and_the_update_can_be_repeated(
  iteration, state, tmp_path: Path, capsys
):
  folder = run_folder.create(tmp_path / "run", CONFIG)
  faults.check(CONFIG, state, folder)
  assert not folder.faults.exists()
  after, _ = iteration(_poison_replay(state))
  with pytest.raises(runs.RunStopped, match="2 updates in a row") as stop:
    faults.check(CONFIG, after, folder)
  assert stop.value.code == runs.FAILED
  (file,) = folder.faults.iterdir()
  # The message ends with a command line that works as it stands.
  command = str(stop.value).rpartition("apnpql ")[2].split()
  capsys.readouterr()
  assert cli.main(command) == 0
  told = capsys.readouterr().out.splitlines()
  assert [line.split()[0] for line in told if "reward_t" in line] == ["batch"]
  # With rewards of zero the very same update is finite.
  arrays: dict[str, Any] = dict(np.load(file, allow_pickle=False))
  np.savez(file, **(arrays | {"batch/reward_t": 0 * arrays["batch/discount_t"]}))
  assert not any(faults.repeat(file).values())
  np.savez(file, **{k: v for k, v in arrays.items() if k != "key"})
  with pytest.raises(ConfigError, match="no update of this run: 'key'"):
    faults.repeat(file)
