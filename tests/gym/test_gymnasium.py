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

from apnpql_jax.config.files import preset_tasks
from apnpql_jax.errors import ConfigError
from apnpql_jax.gym import env_id

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


def test_stable_baselines_accepts_the_environment():
  checker = pytest.importorskip("stable_baselines3.common.env_checker")
  checker.check_env(make(obs="pixels", render_mode="rgb_array").unwrapped)


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


def test_stable_baselines_sees_the_ends_of_episodes():
  vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
  from apnpql_jax.gym.stable_baselines import StableBaselinesVecEnv

  worlds = vec_env.VecMonitor(StableBaselinesVecEnv("push_plate", 2, **SHORT))
  worlds.seed(0)
  first = worlds.reset()
  still = np.zeros((2, 7), np.float32)
  steps = [worlds.step(still) for _ in range(4)]
  assert [done.tolist() for _, _, done, _ in steps] == [[False] * 2] * 2 + [
    [True] * 2,
    [False] * 2,
  ]
  observation, _, _, infos = steps[2]
  for world, info in enumerate(infos):
    assert info["TimeLimit.truncated"] and not info["is_success"]
    assert info["episode"]["l"] == 3
    # The hand has opened; in the observation of the next episode it is closed again.
    last, begun = info["terminal_observation"], observation["robot"][world]
    assert last["robot"][-1] < first["robot"][world, -1] - 0.1
    np.testing.assert_allclose(begun[-1], first["robot"][world, -1], atol=1e-3)
