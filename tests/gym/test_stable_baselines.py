"""The environments as Stable-Baselines3 sees them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecMonitor

from apnpql_jax.gym.envs import ManipulationEnv
from apnpql_jax.gym.stable_baselines import StableBaselinesVecEnv

SMALL: dict[str, Any] = {"obs": "state", "bank_rows": 16, "backend": "native"}


def test_the_environment_is_accepted():
  settings: dict[str, Any] = SMALL | {"obs": "pixels", "render_mode": "rgb_array"}
  check_env(ManipulationEnv("push_plate", **settings))


def test_episodes_end():
  worlds = VecMonitor(
    StableBaselinesVecEnv("push_plate", 2, time_limit_s=0.45, **SMALL)
  )
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


def test_frames_show_all_worlds():
  worlds = StableBaselinesVecEnv("push_plate", 2, render_mode="rgb_array", **SMALL)
  worlds.reset()
  images = np.stack([image for image in worlds.get_images() if image is not None])
  assert len(images) == 2 and (images[0] != images[1]).any()
  np.testing.assert_array_equal(worlds.render(), np.concatenate([*images]))
  assert worlds.metadata["render_fps"] == 7
  assert StableBaselinesVecEnv("push_plate", 2, **SMALL).get_images() == [None, None]


def test_a_world_that_breaks_ends_its_episode():
  worlds = StableBaselinesVecEnv("push_plate", 2, **SMALL)
  before = worlds.reset()
  actions = np.zeros((2, 7), np.float32)
  actions[1, 0] = np.nan
  _, _, done, infos = worlds.step(actions)
  assert done.tolist() == [info["fault"] for info in infos] == [False, True]
  assert infos[1]["TimeLimit.truncated"] and not infos[1]["is_success"]
  last = infos[1]["terminal_observation"]["robot"]
  np.testing.assert_array_equal(last, before["robot"][1])
