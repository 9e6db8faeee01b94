"""The environments as Gymnasium sees them, checked by Gymnasium itself."""

from __future__ import annotations

import subprocess
import sys
from typing import Any
import warnings

import gymnasium
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode
import jax
import numpy as np
import pytest

from apnpql_jax.cli.new_task import NewTask, new_task
from apnpql_jax.config.files import preset_tasks
from apnpql_jax.errors import ConfigError
from apnpql_jax.gym import env_id
from apnpql_jax.gym.envs import ManipulationEnv
from apnpql_jax.tasks import task

SMALL: dict[str, Any] = {"obs": "state", "bank_rows": 16, "backend": "native"}
NAMES = {name: env_id(name) for name in preset_tasks()}
SHORT: dict[str, Any] = SMALL | {"time_limit_s": 0.45}
"""Settings with episodes of three control periods."""


def make(name: str = "push_plate", **settings):
  return gymnasium.make(NAMES[name], **SMALL | settings)


@pytest.mark.parametrize(
  ("name", "obs"), [("push_plate", "pixels"), *((name, "state") for name in NAMES)]
)
def test_gymnasium_accepts_the_environment(name, obs):
  env = make(name, obs=obs, render_mode="rgb_array")
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    # Positions have no bounds.
    warnings.filterwarnings("ignore", ".*A Box observation space (min|max)imum value")
    warnings.filterwarnings("ignore", ".*render modes.*|.*render_modes.*")
    check_env(env.unwrapped)


def test_the_expert_solves_an_episode():
  # Gymnasium imports what a colon ends.
  name = f"apnpql_jax.gym:{NAMES['push_plate']}"
  env = gymnasium.make(name, held_out=True, **SMALL)
  env.reset(seed=3)
  for _ in range(93):
    _, reward, terminated, truncated, info = env.step(env.unwrapped.expert_action())
    if terminated or truncated:
      break
  assert terminated and not truncated and reward == 1.0 and info["success"]


def test_a_seed_repeats_the_episodes():
  def played():
    env = make()
    found = [env.reset(seed=5)[0]]
    env.action_space.seed(5)
    for _ in range(4):
      found.append(env.step(env.action_space.sample())[0])
    return [*found, env.reset()[0], env.reset(seed=6)[0]]

  first, second = played(), played()
  assert all(map(data_equivalence, first, second))
  assert not data_equivalence(first[0], first[-1])
  assert not data_equivalence(first[-2], first[0])


def test_held_out_rows_are_never_drawn_otherwise():
  def starts(**settings):
    env = gymnasium.make_vec(NAMES["push_plate"], num_envs=64, **SMALL | settings)
    observations = env.reset(seed=0)[0]["objects"]
    return {tuple(row) for row in observations.round(6).tolist()}

  train, held_out = starts(), starts(held_out=True)
  assert len(train) == 12 and len(held_out) == 4 and not train & held_out


def test_a_vector_steps_as_its_worlds_do_alone():
  """Without automatic resets, a batch equals Gymnasium's vector of single worlds."""
  many = gymnasium.make_vec(NAMES["push_plate"], num_envs=3, **SMALL)
  many.reset(seed=1)
  state = many.unwrapped._worlds.state
  actions = np.random.default_rng(0).uniform(-1, 1, (5, 3, 7)).astype(np.float32)
  batched = [many.step(action)[0] for action in actions]
  for world in range(3):
    one = make()
    one.reset(seed=0)
    one.unwrapped._worlds.state = jax.tree.map(lambda x: x[world : world + 1], state)  # noqa: B023
    for action, expected in zip(actions, batched, strict=True):
      found = one.step(action[world])[0]
      for name, value in found.items():
        np.testing.assert_allclose(value, expected[name][world], atol=1e-5)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_episodes_end_as_in_the_vector_environment_of_gymnasium(mode):
  """Flags, rewards and final infos, world by world, against ``SyncVectorEnv``."""
  ours = gymnasium.make_vec(
    NAMES["push_plate"], num_envs=2, autoreset_mode=mode, **SHORT
  )
  theirs = gymnasium.vector.SyncVectorEnv(
    [lambda: make(**SHORT)] * 2, autoreset_mode=mode
  )
  assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"] is mode
  assert ours.observation_space == theirs.observation_space
  assert ours.action_space == theirs.action_space
  both = ours, theirs
  for envs in both:
    envs.reset(seed=0)
  still = np.zeros(ours.action_space.shape, np.float32)
  for period in range(8):
    (obs, *flags, info), (other, *expected, their_info) = (e.step(still) for e in both)
    for found, wanted in zip(flags, expected, strict=True):
      np.testing.assert_array_equal(found, wanted)
    assert obs in ours.observation_space and other in ours.observation_space
    assert info.keys() >= their_info.keys(), period
    done = flags[1] | flags[2]
    if mode is AutoresetMode.SAME_STEP and done.any():
      assert info["final_obs"].dtype == their_info["final_obs"].dtype
      for final in info["final_obs"]:
        assert final in ours.single_observation_space
        # The arm stood still, and a reset moves it to another pose.
        assert not data_equivalence(final, {k: v[0] for k, v in obs.items()})
    if mode is AutoresetMode.DISABLED and done.any():
      with pytest.raises(gymnasium.error.ResetNeeded, match="worlds \\[0 1\\]"):
        ours.step(still)
      for envs in both:
        envs.reset(options={"reset_mask": done.copy()})


def test_what_a_step_returns_belongs_to_the_caller():
  """Who may write into it, as into what other environments return."""
  one, mode = make(**SHORT), AutoresetMode.SAME_STEP
  many = gymnasium.make_vec(
    NAMES["push_plate"], num_envs=2, autoreset_mode=mode, **SHORT
  )
  returned = [one.reset(seed=0)[0], many.reset(seed=0)[0], one.step(np.zeros(7))[0]]
  for _ in range(3):
    observation, *flags, info = many.step(np.zeros((2, 7)))
    returned += [observation, flags]
  returned += [info["final_obs"].tolist(), info["final_info"], info["fault"]]
  for array in jax.tree.leaves(returned):
    array[...] = 0  # Would fail for a view of an array of JAX.


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_success_ends_episodes_as_in_the_vector_environment_of_gymnasium(mode):
  """The expert plays the same worlds in both until an episode is over."""
  ours = gymnasium.make_vec(
    NAMES["push_plate"], num_envs=2, autoreset_mode=mode, **SMALL
  )
  theirs = gymnasium.vector.SyncVectorEnv([make] * 2, autoreset_mode=mode)
  ours.reset(seed=3), theirs.reset(seed=3)
  state = ours.unwrapped._worlds.state
  for world, env in enumerate(theirs.envs):
    one = jax.tree.map(lambda x: x[world : world + 1], state)  # noqa: B023
    env.unwrapped._worlds.state = one
  for _ in range(93):
    action = ours.unwrapped.expert_action()
    (_, *flags, info), (_, *expected, their_info) = (
      e.step(action) for e in (ours, theirs)
    )
    for found, wanted in zip(flags, expected, strict=True):
      np.testing.assert_array_equal(found, wanted)
    if flags[1].any():
      break
  reward, solved, truncated = flags
  assert solved.any() and not truncated.any()
  np.testing.assert_array_equal(reward, solved)
  observations = info.pop("final_obs", None), their_info.pop("final_obs", None)
  assert data_equivalence(info, their_info)
  if mode is AutoresetMode.SAME_STEP:
    np.testing.assert_array_equal(info["final_info"]["success"], solved)
    for world in np.flatnonzero(solved):
      final, their_final = (x[world] for x in observations)
      for name, value in final.items():
        np.testing.assert_allclose(value, their_final[name], atol=1e-4)
  else:
    _, reward, terminated, _, info = ours.step(action)
    assert not (reward[solved].any() or (terminated & solved).any())
    assert not info["success"][solved].any()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_a_world_that_breaks_ends_its_episode(mode):
  """Its last observation is the one before, as its next one is of another episode."""
  envs = gymnasium.make_vec(
    NAMES["push_plate"], num_envs=3, autoreset_mode=mode, **SMALL
  )
  envs.reset(seed=0)
  still = np.zeros((3, 7), np.float32)
  before = envs.step(still)[0]["robot"]
  actions, broken = still.copy(), np.array([False, True, False])
  actions[1, 0] = np.nan
  observation, reward, terminated, truncated, info = envs.step(actions)
  np.testing.assert_array_equal(truncated, broken)
  assert not terminated.any() and not reward.any()
  last = observation["robot"]
  if mode is AutoresetMode.SAME_STEP:
    assert (last[1] != before[1]).any()
    last, info = {1: info["final_obs"][1]["robot"]}, info["final_info"]
  np.testing.assert_array_equal(info["fault"], broken)
  np.testing.assert_array_equal(last[1], before[1])
  after, _, _, truncated, info = envs.step(still)
  assert (after["robot"][1] != before[1]).any()
  assert not truncated.any() and not info["fault"].any()


def test_every_reset_draws_a_new_world_but_held_out_rows():
  """At ``reset`` and where an episode is over, of 12 training and 4 held-out rows."""

  def drawn(**settings):
    envs = gymnasium.make_vec(
      NAMES["push_plate"], num_envs=16, randomize=True, **SHORT | settings
    )
    envs.reset(seed=0)
    begun = [envs.unwrapped._worlds.state]
    for _ in range(4):
      envs.step(np.zeros((16, 7), np.float32))
    begun.append(envs.unwrapped._worlds.state)
    envs.reset(options={"reset_mask": np.ones(16, bool)})
    begun.append(envs.unwrapped._worlds.state)
    assert not any(state.elapsed.any() for state in begun)
    fields = [x for state in begun for x in jax.tree.leaves(state.physics.fields)]
    rows = [x.reshape(16, -1) for x in fields]
    worlds = np.concatenate(rows, axis=-1).reshape(16, 3, -1).reshape(48, -1)
    return np.unique(worlds.round(5), axis=0)

  assert len(drawn()) == 48 and len(drawn(held_out=True)) == 4


def test_the_file_of_a_task_has_its_preset(tmp_path, monkeypatch):
  """By its path and, once it has been executed, by the name of the task."""
  monkeypatch.setattr(task, "_REGISTRY", dict(task._REGISTRY))
  new_task(NewTask(name="my_ball", folder=tmp_path))
  file = tmp_path / "my_ball.py"
  changed = 'task="my_ball", time_limit_s=6.0'
  file.write_text(file.read_text().replace('task="my_ball"', changed))
  env = ManipulationEnv(str(file), **SMALL)
  env.reset(seed=0)
  for _ in range(40):
    _, reward, terminated, truncated, _ = env.step(env.expert_action())
    if terminated or truncated:
      break
  assert terminated and reward == 1.0
  config = env._worlds.env.config
  assert config.time_limit_s == 6.0 and config.task_file == str(file)
  assert ManipulationEnv("my_ball", **SMALL)._worlds.env.config == config


def test_a_mask_resets_only_some_worlds():
  envs = gymnasium.make_vec(NAMES["push_plate"], num_envs=3, **SMALL)
  envs.reset(seed=0)
  before, *_ = envs.step(envs.action_space.sample())
  mask = np.array([False, True, False])
  after, _ = envs.reset(options={"reset_mask": mask})
  changed = (before["robot"] != after["robot"]).any(axis=-1)
  np.testing.assert_array_equal(changed, mask)


def test_frames_show_each_world():
  envs = gymnasium.make_vec(
    NAMES["push_plate"], num_envs=2, render_mode="rgb_array", **SMALL
  )
  envs.reset(seed=0)
  frames = envs.render()
  assert len(frames) == 2 and frames[0].shape == (506, 674, 3)
  assert frames[0].dtype == np.uint8 and (frames[0] != frames[1]).any()


def test_errors_name_the_setting_and_the_missing_reset():
  with pytest.raises(ConfigError, match="obs"):
    make(obs="sounds")
  with pytest.raises(gymnasium.error.ResetNeeded):
    make().unwrapped.step(np.zeros(7))


def test_registering_the_tasks_imports_neither_jax_nor_mujoco():
  code = (
    "import sys, apnpql_jax.gym, gymnasium; gymnasium.spec('apnpql/StackBox-v0'); "
    "assert not {'jax', 'mujoco'} & set(sys.modules)"
  )
  subprocess.run([sys.executable, "-c", code], check=True)
