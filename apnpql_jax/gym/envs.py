"""The environments as ``gymnasium.Env`` and ``gymnasium.vector.VectorEnv``.

    import apnpql_jax.gym
    env = gymnasium.make("apnpql/PushPlate-v0", obs="state")
    envs = gymnasium.make_vec("apnpql/PushPlate-v0", num_envs=32)

Keyword arguments are settings of ``EnvConfig``; the others are those of the task's
preset. Episodes start from the bank's training rows, or from its held-out rows with
``held_out=True``.

- Action, f32[7] in [-1, 1]: joint velocities in rad/s, then the gripper, which closes
  where the value is positive.
- Observation: a dictionary with the fields of ``types.Observation``.
- Reward: 1 at the instant of success, which terminates the episode, otherwise 0. The
  time limit truncates it; Gymnasium's ``TimeLimit`` is not needed.
- ``info["success"]``: whether the task is solved.
- ``info["fault"]``: whether the world has become non-finite. This truncates the
  episode, with the observation before it.

With ``randomize=True``, every reset draws a new world. Only held-out rows always have
the same one, as in evaluations.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.config import files
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import VIEW_SIZE, camera_renderer
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState, truncate_faults, where_world
from apnpql_jax.types import ACTION_DIM, Array

Json = dict[str, Any]


class Worlds:
  """Worlds of a task as Gymnasium sees them: NumPy arrays, one random generator."""

  def __init__(self, task: str, count: int, *, held_out: bool, settings: Json):
    """Builds ``count`` worlds; ``settings`` replace those of the task's preset.

    Raises:
      ConfigError: A setting is invalid, or there is no such task.
      UserError: JAX has run something before it could be configured.
    """
    runtime.configure()
    config = dataclasses.replace(files.task_env(task), **settings, worlds=count)
    self.env: Env = make_env(config)
    self.count, self._held_out = count, held_out
    self.state: EnvState | None = None
    self.faults = np.zeros(count, bool)
    self._reset, self._step = jax.jit(self.env.reset), jax.jit(self._advance)
    self._merge, self._expert = jax.jit(_merged), jax.jit(self.env.expert_action)
    example = jax.eval_shape(self.env.reset, jnp.zeros(count, jnp.int32)).observation
    boxes = {name: _box(x) for name, x in example.present().items()}
    self.observation_space = spaces.Dict(boxes)
    self.action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

  @functools.cached_property
  def _view(self) -> Any:
    """A jitted function that draws the robot, u8[worlds, H, W, 3]."""
    scene = self.env.task.scene
    camera = camera_renderer(self.env.config, scene, "wide", VIEW_SIZE)
    return jax.jit(lambda physics: self.env.view(camera, physics))

  def reset(self, rng: np.random.Generator, mask: np.ndarray | None = None) -> None:
    """Starts an episode in every world, or where ``mask`` bool[worlds] is true."""
    rows = self._rows(rng)
    # Plain worlds need no keys, and drawing them would change the rows that follow.
    keys = self._keys(rng) if self.env.config.randomize else None
    state = self._reset(rows, keys)
    if mask is not None and self.state is not None:
      state = self._merge(jnp.asarray(mask), state, self.state)
    self.state = state

  def step(self, actions: np.ndarray, rng: np.random.Generator) -> None:
    """Runs one control period; a world whose episode is over starts another one."""
    before, rows = self._started(), self._rows(rng)
    self.state = self._step(before, jnp.asarray(actions), rows, self._keys(rng))
    self.faults = np.array(self.state.faults > before.faults)

  def observation(self) -> dict[str, np.ndarray]:
    """Returns the observations, each with a first axis of worlds, for the caller."""
    observation = self._started().observation
    return {k: np.array(getattr(observation, k)) for k in self.observation_space}

  def flags(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns reward f64[worlds], terminated and truncated bool[worlds]."""
    timestep = self._started().timestep
    reward = np.array(timestep.reward, np.float64)
    return reward, np.array(timestep.terminated), np.array(timestep.truncated)

  def draw(self) -> np.ndarray:
    """Returns a view of the robot in each world, u8[worlds, H, W, 3]."""
    return np.array(self._view(self._started().physics))

  def expert_action(self) -> np.ndarray:
    """Returns the actions of the task's scripted expert, f32[worlds, 7]."""
    action = np.array(self._expert(self._started()))
    action[:, -1] = np.where(action[:, -1] > 0.5, 1.0, -1.0)
    return action

  def _rows(self, rng: np.random.Generator) -> Array:
    """Draws a row of the bank for each world, i32[worlds]."""
    split = self.env.bank_split
    ends = (split, split + self.env.held_out) if self._held_out else (0, split)
    return jnp.asarray(rng.integers(*ends, self.count))

  def _keys(self, rng: np.random.Generator) -> PRNGKeyArray | None:
    """Draws a key for each world; None if their rows determine the randomization."""
    seed = rng.integers(2**31)
    if self._held_out:
      return None
    return jax.random.split(jax.random.key(seed), self.count)

  def _advance(
    self, state: EnvState, action: Array, rows: Array, keys: PRNGKeyArray | None
  ) -> EnvState:
    velocity, close = action[:, :-1], action[:, -1:] > 0.0
    action = jnp.concatenate([velocity.clip(-1.0, 1.0), close], axis=-1)
    arrival = self.env.advance_or_begin(state, action, rows, keys)
    return truncate_faults(state, self.env.observe(arrival))

  def _started(self) -> EnvState:
    if self.state is None:
      raise gymnasium.error.ResetNeeded("call reset() first")
    return self.state


class ManipulationEnv(gymnasium.Env):
  """One world of a task; see the module for spaces, reward and settings."""

  metadata = {"render_modes": ["rgb_array"], "render_fps": 7}

  def __init__(
    self,
    task: str,
    *,
    render_mode: str | None = None,
    held_out: bool = False,
    **settings: Any,
  ):
    """Builds the world; see ``Worlds`` for settings and errors."""
    self.render_mode = render_mode
    self._worlds = Worlds(task, 1, held_out=held_out, settings=settings)
    self.metadata = self.metadata | _rate(self._worlds.env.config)
    self.observation_space = self._worlds.observation_space
    self.action_space = self._worlds.action_space

  def reset(
    self, *, seed: int | None = None, options: Json | None = None
  ) -> tuple[dict[str, np.ndarray], Json]:
    """Starts an episode; ``seed`` determines it and those that follow."""
    super().reset(seed=seed)
    self._worlds.reset(self.np_random)
    return self._observation(), {"success": False, "fault": False}

  def step(
    self, action: np.ndarray
  ) -> tuple[dict[str, np.ndarray], float, bool, bool, Json]:
    """Runs one control period."""
    self._worlds.step(np.asarray(action, np.float32)[None], self.np_random)
    reward, terminated, truncated = (x[0].item() for x in self._worlds.flags())
    info = {"success": terminated, "fault": self._worlds.faults[0].item()}
    return self._observation(), reward, terminated, truncated, info

  def render(self) -> np.ndarray | None:
    """Returns a view of the robot, u8[H, W, 3]; None without a render mode."""
    return self._worlds.draw()[0] if self.render_mode else None

  def expert_action(self) -> np.ndarray:
    """Returns the action of the task's scripted expert, f32[7]."""
    return self._worlds.expert_action()[0]

  def _observation(self) -> dict[str, np.ndarray]:
    return {k: v[0] for k, v in self._worlds.observation().items()}


class ManipulationVectorEnv(gymnasium.vector.VectorEnv):
  """Worlds of a task in one program; see the module for spaces, reward and settings.

  All modes of ``AutoresetMode`` are supported. NEXT_STEP costs nothing. SAME_STEP
  resets and observes all worlds whenever an episode ends.
  """

  metadata = {
    "render_modes": ["rgb_array"],
    "render_fps": 7,
    "autoreset_mode": AutoresetMode.NEXT_STEP,
  }

  def __init__(
    self,
    task: str,
    num_envs: int = 1,
    *,
    render_mode: str | None = None,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    held_out: bool = False,
    **settings: Any,
  ):
    """Builds ``num_envs`` worlds; see ``Worlds`` for settings and errors."""
    self.num_envs, self.render_mode = num_envs, render_mode
    self._mode = AutoresetMode(autoreset_mode)
    self._worlds = Worlds(task, num_envs, held_out=held_out, settings=settings)
    self.metadata = self.metadata | _rate(self._worlds.env.config)
    self.metadata["autoreset_mode"] = self._mode
    self.single_observation_space = self._worlds.observation_space
    self.single_action_space = self._worlds.action_space
    self.observation_space = batch_space(self.single_observation_space, num_envs)
    self.action_space = batch_space(self.single_action_space, num_envs)

  def reset(
    self, *, seed: int | None = None, options: Json | None = None
  ) -> tuple[dict[str, np.ndarray], Json]:
    """Starts an episode in every world, or in those of ``options["reset_mask"]``."""
    super().reset(seed=seed)
    mask = (options or {}).get("reset_mask")
    self._worlds.reset(self.np_random, mask)
    return self._worlds.observation(), self._info()

  def step(
    self, actions: np.ndarray
  ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, Json]:
    """Runs one control period in every world.

    Raises:
      ResetNeeded: The mode is DISABLED, and an episode is over.
    """
    worlds = self._worlds
    if self._mode is AutoresetMode.DISABLED and (done := self._done()).any():
      raise gymnasium.error.ResetNeeded(
        f"episodes of worlds {np.flatnonzero(done)} are over; reset them by reset_mask"
      )
    worlds.step(np.asarray(actions, np.float32), self.np_random)
    reward, terminated, truncated = worlds.flags()
    info, done = self._info(terminated, worlds.faults), terminated | truncated
    if self._mode is AutoresetMode.SAME_STEP and done.any():
      info = self._info() | self._final(done, info)
      worlds.reset(self.np_random, done)
    return worlds.observation(), reward, terminated, truncated, info

  def render(self) -> tuple[np.ndarray, ...] | None:
    """Returns a view of the robot in each world, u8[H, W, 3]."""
    return tuple(self._worlds.draw()) if self.render_mode else None

  def expert_action(self) -> np.ndarray:
    """Returns the actions of the task's scripted expert, f32[num_envs, 7]."""
    return self._worlds.expert_action()

  def _done(self) -> np.ndarray:
    _, terminated, truncated = self._worlds.flags()
    return terminated | truncated

  def _info(self, success: Any = False, fault: Any = False) -> Json:
    """Returns the infos of all worlds; each argument is bool[worlds], or for all."""
    everywhere = np.ones(self.num_envs, bool)
    infos = {"success": success & everywhere, "fault": fault & everywhere}
    return infos | {f"_{name}": everywhere for name in infos}

  def _final(self, done: np.ndarray, info: Json) -> Json:
    """Returns the last observations and infos of the episodes that are over."""
    observation = self._worlds.observation()
    final = np.full(self.num_envs, None, object)
    for i in np.flatnonzero(done):
      final[i] = {k: v[i] for k, v in observation.items()}
    return {
      "final_obs": final,
      "_final_obs": done,
      "final_info": info | {"_success": done, "_fault": done},
      "_final_info": done,
    }


def _box(example: jax.ShapeDtypeStruct) -> spaces.Box:
  """Returns the space of one world's values."""
  shape = example.shape[1:]
  if example.dtype == np.uint8:
    return spaces.Box(0, 255, shape, np.uint8)
  return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _rate(config: EnvConfig) -> Json:
  return {"render_fps": round(1.0 / config.control_period_s)}


def _merged(mask: Array, yes: EnvState, no: EnvState) -> EnvState:
  return jax.tree.map(functools.partial(where_world, mask), yes, no)
