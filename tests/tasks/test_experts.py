"""Scripted experts on real physics: success, limits of motion, disturbances."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import numpy as np
import pytest

from apnpql_jax.config.schema import EnvConfig, ReplayConfig
from apnpql_jax.envs.env import HISTORY, Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import task_names
from apnpql_jax.training.rollout import expert_policy
from apnpql_jax.types import Array

ROWS = 128
WORLDS = 16
PUSHED = {
  "flip_cup": ("cup", 0.02),
  "push_plate": ("plate", 0.05),
  "stack_box": ("yellow", 0.03),
}
"""Task -> body that is pushed aside, and how far, m."""

SWUNG = {
  "flip_cup": ("cup", 32, 0.08),
  "place_plate": ("plate", 28, 0.08),
  "stack_box": ("yellow", 22, 0.035),
}
"""Task -> body that is turned in the hand, when, and its height by then, m."""

Step = Callable[[EnvState, PRNGKeyArray, float], EnvState]
"""(worlds, key, noise of the expert in rad/s) -> worlds one period later."""

MJX = [pytest.param((n, "mjx"), marks=pytest.mark.slow) for n in task_names()]

ENGINES = [*((name, "native") for name in task_names()), *MJX]


@pytest.fixture(scope="module", params=ENGINES, ids="-".join)
def env(request) -> Env:
  task, backend = request.param
  return make_env(EnvConfig(task=task, obs="state", backend=backend, bank_rows=ROWS))


@pytest.fixture(scope="module")
def step(env) -> Step:
  @jax.jit
  def act(state: EnvState, key: PRNGKeyArray, noise: float) -> Array:
    return expert_policy(env, noise=noise)(state, key)[0]

  def step(state: EnvState, key: PRNGKeyArray, noise: float) -> EnvState:
    return env.step(state, act(state, jax.random.fold_in(key, 1), noise), key)

  return step


def play(
  env: Env,
  step: Step,
  disturb: Callable[[int, PhysicsState], PhysicsState] = lambda t, physics: physics,
  *,
  noise: float = 0.0,
  first: int = 0,
) -> Iterator[EnvState]:
  """Plays ``WORLDS`` episodes; ``disturb`` edits the state before each period."""
  state = env.reset(first + jnp.arange(WORLDS))
  for t in range(env.config.episode_steps):
    state = state.replace(physics=disturb(t, state.physics))
    state = step(state, jax.random.key(t), noise)
    yield state


def solved(instants: Iterator[EnvState]) -> int:
  """Counts the first episodes that are solved."""
  done, over = np.zeros(WORLDS, bool), np.zeros(WORLDS, bool)
  for state in instants:
    done |= ~over & np.asarray(state.timestep.terminated)
    over |= np.asarray(state.timestep.last)
    if over.all():
      break
  return done.sum()


@pytest.fixture(scope="module")
def instants(env, step) -> list[EnvState]:
  """Returns undisturbed episodes."""
  return list(play(env, step))


def test_the_expert_solves_its_task_with_the_noise_of_its_replay(env, step):
  noise = ReplayConfig().expert_noise
  plays = [play(env, step, noise=noise, first=first) for first in (0, WORLDS)]
  assert sum(map(solved, plays)) >= 31


def test_the_expert_solves_its_task(instants):
  assert solved(iter(instants)) >= 15


def test_the_expert_keeps_the_limits_of_the_agent(env, instants):
  """Its actions are in the action box; joints and fingers keep their limits.

  Only the approach is checked, because contacts brake harder.
  """
  actions = np.stack([state.timestep.primitives for state in instants])
  assert np.abs(actions[..., :6]).max() <= 1.0
  assert np.isin(actions[..., 6], (0.0, 1.0)).all()
  period = env.config.control_period_s
  robot = np.stack([state.timestep.observation.robot for state in instants[:8]])
  robot = robot.reshape(-1, HISTORY, 7).astype(np.float64)
  speed = np.diff(robot[..., :6], axis=1) / period
  assert 0.5 < np.abs(speed).max() < 1.02
  assert 1.0 < np.abs(np.diff(speed, axis=1)).max() / period < 1.2 * 1.05
  gap = 2 * (0.0041 + 0.057 * np.cos(robot[..., 6] + np.pi / 6))
  assert np.abs(np.diff(gap, axis=1)).max() / period < 0.075 * 1.12


def test_success_is_rewarded_once(env, instants):
  """The reward is +1 at the last instant; the next one begins another episode."""
  reward = np.stack([state.timestep.reward for state in instants])
  solved = np.stack([state.timestep.terminated for state in instants])
  elapsed = np.stack([state.elapsed for state in instants])
  assert solved.any()
  np.testing.assert_array_equal(reward, solved.astype(np.float32))
  assert not elapsed[1:][solved[:-1]].any() and not reward[1:][solved[:-1]].any()


def test_the_expert_recovers_when_the_object_is_pushed_away(env, step):
  """The push happens while the arm approaches."""
  if env.task.name not in PUSHED:
    pytest.skip("a holder is in the way, or a user's task")
  body, far = PUSHED[env.task.name]
  address, _ = env.task.scene.free_joint(body)
  aside = jnp.asarray([far, -far]) / np.sqrt(2)

  def push(t: int, physics: PhysicsState) -> PhysicsState:
    if t != 8:
      return physics
    qpos = physics.qpos.at[:, address : address + 2].add(aside)
    return physics.replace(qpos=qpos)

  assert solved(play(env, step, push)) >= 15


def test_the_expert_recovers_when_the_object_swings_in_the_hand(env, step):
  if env.task.name not in SWUNG:
    pytest.skip("nothing is carried, or a user's task")
  body, period, height = SWUNG[env.task.name]
  address, dof = env.task.scene.free_joint(body)

  def swing(t: int, physics: PhysicsState) -> PhysicsState:
    if t != period:
      return physics
    assert (physics.qpos[:, address + 2] > height).mean() > 0.8  # Lifted.
    return physics.replace(qvel=physics.qvel.at[:, dof + 3 : dof + 6].add(3.0))

  assert solved(play(env, step, swing)) >= 15
