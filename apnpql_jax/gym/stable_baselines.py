"""Worlds of a task as a vectorized environment of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium.vector import AutoresetMode
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from apnpql_jax.gym.envs import ManipulationVectorEnv

Observations = dict[str, np.ndarray]


class StableBaselinesVecEnv(VecEnv):
  """A ``ManipulationVectorEnv`` with the interface of ``VecEnv``.

  One program steps all worlds. ``DummyVecEnv`` would step them one after the other.
  """

  def __init__(self, task: str, num_envs: int, **settings: Any):
    """Builds the worlds; see ``gym.envs.Worlds`` for settings and errors."""
    self.worlds = ManipulationVectorEnv(
      task, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **settings
    )
    self._actions = np.zeros(self.worlds.action_space.shape or ())
    spaces = self.worlds.single_observation_space, self.worlds.single_action_space
    super().__init__(num_envs, *spaces)
    self.metadata["render_fps"] = self.worlds.metadata["render_fps"]

  def reset(self) -> Observations:
    """Starts an episode in every world; ``seed`` before it determines which."""
    observation, info = self.worlds.reset(seed=self._seeds[0])
    self.reset_infos = [{"success": x} for x in info["success"].tolist()]
    self._reset_seeds()
    return observation

  def step_async(self, actions: np.ndarray) -> None:
    """Stores the actions of the next step."""
    self._actions = actions

  def step_wait(self) -> tuple[Observations, np.ndarray, np.ndarray, list[dict]]:
    """Runs one control period in every world; ended episodes start again at once."""
    observation, reward, terminated, truncated, info = self.worlds.step(self._actions)
    faults = info.get("final_info", info)["fault"]
    flags = (x.tolist() for x in (terminated, truncated, faults))
    infos: list[dict[str, Any]] = [
      {"success": x, "is_success": x, "TimeLimit.truncated": late, "fault": fault}
      for x, late, fault in zip(*flags, strict=True)
    ]
    done = terminated | truncated
    for world in np.flatnonzero(done):
      infos[world]["terminal_observation"] = info["final_obs"][world]
    return observation, reward.astype(np.float32), done, infos

  def get_images(self) -> Sequence[np.ndarray | None]:
    """Returns a view of the robot in each world, u8[H, W, 3], as ``render`` needs."""
    return self.worlds.render() or [None] * self.num_envs

  def close(self) -> None:
    """Does nothing: the worlds are arrays."""

  def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
    """Returns an attribute of the worlds, once for each index."""
    return [getattr(self.worlds, attr_name)] * len(self._indices(indices))

  def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
    """Raises: the worlds share their attributes."""
    raise AttributeError(f"{attr_name} of single worlds cannot be set")

  def env_method(
    self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
  ) -> list[Any]:
    """Calls a method of all worlds and returns the rows of its result."""
    results = getattr(self.worlds, method_name)(*args, **kwargs)
    return [results[i] for i in self._indices(indices)]

  def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
    """Returns False for each index: single worlds have no wrappers."""
    return [False] * len(self._indices(indices))

  def _indices(self, indices: Any) -> Sequence[int]:
    return list(self._get_indices(indices))
