"""Stable-Baselines3's SAC with demonstrations, for tasks observed as states.

    learner = make_sac("push_plate", seed=0)
    learner.learn(30_720)
    print(success_rate(learner, held_out_worlds("push_plate", 64)))

With its defaults, SAC does not learn from a reward that comes only at the end of an
episode. Four things are added: expert transitions as half of each batch, with layer
normalization (RLPD, Ball et al. 2023); five-step returns; inputs of order one; and a
policy that starts narrow. The rest is Stable-Baselines3's.
"""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
import torch

from apnpql_jax.config.files import task_preset
from apnpql_jax.gym.stable_baselines import Observations, StableBaselinesVecEnv

N_STEP, GAMMA = 5, 0.99
TARGET_ENTROPY = -14.0  # nats, of 7 actions in [-1, 1]
_INITIAL_LOG_STD = -2.0
_NEAR = 0.05, 0.2  # m; distances from the tool within which points are seen in detail


def make_sac(
  task: str, *, worlds: int = 16, updates: int = 8, seed: int = 0, **options: Any
) -> SAC:
  """Builds SAC with a replay that has demonstrations of a task.

  Args:
    task: Name of the task, or the path of its file.
    worlds: Worlds that one program steps.
    updates: Gradient steps after each step of the worlds.
    seed: Random seed of networks, actions and episodes.
    options: Arguments of ``stable_baselines3.SAC`` that replace these, other than
      those of the replay.
  """
  replay = task_preset(task).replay
  env = StateVector(StableBaselinesVecEnv(task, worlds, **_shared(task)))
  returns = {"n_steps": N_STEP, "gamma": options.get("gamma", GAMMA)}
  learner = SAC(
    "MlpPolicy",
    env,
    **{
      "gamma": GAMMA,
      "learning_starts": 0,
      "buffer_size": 200_000,
      "gradient_steps": updates,
      "ent_coef": "auto_0.01",
      "target_entropy": TARGET_ENTROPY,
      "policy_kwargs": {"activation_fn": NormalizedReLU},
      "seed": seed,
      **options,
    },
    replay_buffer_class=HalfDemonstrations,
    replay_buffer_kwargs=returns,
  )
  with torch.no_grad():
    learner.actor.log_std.bias.fill_(_INITIAL_LOG_STD)
  spaces_of = env.observation_space, env.action_space
  demonstrations = NStepReplayBuffer(
    replay.expert_steps, *spaces_of, device=learner.device, n_envs=worlds, **returns
  )
  fill(demonstrations, env, noise=replay.expert_noise, seed=seed)
  learner.replay_buffer.demonstrations = demonstrations
  return learner


def held_out_worlds(task: str, count: int) -> VecEnv:
  """Returns worlds that start from held-out rows of the reset bank."""
  return StateVector(StableBaselinesVecEnv(task, count, held_out=True, **_shared(task)))


def success_rate(learner: SAC, worlds: VecEnv) -> float:
  """Returns the share of worlds whose first episode the mean action solves."""
  worlds.seed(0)
  observation = worlds.reset()
  solved, over = np.zeros(worlds.num_envs, bool), np.zeros(worlds.num_envs, bool)
  while not over.all():
    action, _ = learner.predict(observation, deterministic=True)
    observation, _, done, infos = worlds.step(action)
    success = np.array([info["success"] for info in infos])
    solved |= success & ~over
    over |= done
  return float(solved.mean())


class HalfDemonstrations(NStepReplayBuffer):
  """A replay whose batches are half demonstrations."""

  demonstrations: NStepReplayBuffer

  def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
    """Draws one half of the batch from each buffer."""
    parts = (
      super().sample(batch_size // 2, env),
      self.demonstrations.sample(batch_size - batch_size // 2, env),
    )
    return ReplayBufferSamples(*map(torch.cat, zip(*parts, strict=True)))


class NormalizedReLU(torch.nn.Module):
  """A ReLU after a layer norm without parameters."""

  def forward(self, x: torch.Tensor) -> torch.Tensor:
    """Normalizes the last axis of ``x`` and rectifies it."""
    return torch.relu(torch.nn.functional.layer_norm(x, x.shape[-1:]))


class StateVector(VecEnvWrapper):
  """Observations as one vector of order one: points are seen from the tool."""

  def __init__(self, venv: VecEnv):
    """Wraps worlds with ``obs="state"``."""
    example = {k: v[None] for k, v in venv.observation_space.sample().items()}
    shape = state_vector(example).shape[1:]
    super().__init__(venv, spaces.Box(-np.inf, np.inf, shape, np.float32))

  def reset(self) -> np.ndarray:
    """Starts an episode in every world."""
    return state_vector(self.venv.reset())

  def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
    """Runs one control period in every world."""
    observation, reward, done, infos = self.venv.step_wait()
    for world in np.flatnonzero(done):
      last = infos[world]["terminal_observation"]
      last = {name: x[None] for name, x in last.items()}
      infos[world]["terminal_observation"] = state_vector(last)[0]
    return state_vector(observation), reward, done, infos


def state_vector(observation: Observations) -> np.ndarray:
  """Returns robot states, their changes, and points seen from the tool, f32[*b, n]."""
  robot, tool = observation["robot"], observation["tool"]
  states = robot.reshape(len(robot), 3, -1)
  away = observation["objects"].reshape(len(robot), -1, 3) - tool[:, None]
  parts = [states[:, -1], np.sin(states[:, -1]), np.cos(states[:, -1])]
  parts += [7.0 * np.diff(states, axis=1), 5.0 * tool]
  parts += [np.tanh(away / near) for near in _NEAR]
  flat = [x.reshape(len(robot), -1) for x in parts]
  return np.concatenate(flat, axis=-1).astype(np.float32)


def fill(
  buffer: NStepReplayBuffer, worlds: StateVector, *, noise: float, seed: int
) -> None:
  """Fills a buffer with transitions of the scripted expert.

  ``noise`` is the standard deviation that is added to its velocities, rad/s.
  """
  rng = np.random.default_rng(seed)
  worlds.seed(seed)
  observation = worlds.reset()
  while not buffer.full:
    action = np.stack(worlds.env_method("expert_action"))
    action[:, :-1] += noise * rng.standard_normal(action[:, :-1].shape)
    action = action.clip(-1.0, 1.0)
    after, reward, done, infos = worlds.step(action)
    follows = after.copy()
    for world in np.flatnonzero(done):
      follows[world] = infos[world]["terminal_observation"]
    buffer.add(observation, follows, action, reward, done, infos)
    observation = after


def _shared(task: str) -> dict[str, Any]:
  """Returns the settings that training and evaluation have in common."""
  return {"obs": "state", "bank_rows": task_preset(task).env.bank_rows}
