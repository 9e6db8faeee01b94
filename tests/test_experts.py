"""Every task's scripted expert on real physics: held-out episodes, disturbances."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config import EnvConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.evaluate import make_player, play_held_out
from apnpql_jax.rollout import expert_policy
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import task_names

ROWS = 128
PUSHED = {
  "flip_cup": ("cup", 0.02),
  "push_plate": ("plate", 0.05),
  "stack_box": ("yellow", 0.03),
}
"""Task -> what is moved aside, and how far, m."""

SWUNG = {
  "flip_cup": ("cup", 32, 0.08),
  "place_plate": ("plate", 28, 0.08),
  "stack_box": ("yellow", 22, 0.035),
}
"""Task -> what is turned in the hand, when, and the height in m it has by then."""


MJX = [pytest.param((n, "mjx"), marks=pytest.mark.slow) for n in task_names()]


ENGINES = [*((name, "native") for name in task_names()), *MJX]


@pytest.fixture(scope="module", params=ENGINES, ids="-".join)
def env(request) -> Env:
  task, backend = request.param
  return make_env(EnvConfig(task=task, obs="state", backend=backend, bank_rows=ROWS))


def test_the_expert_solves_its_task(env):
  player = make_player(env, lambda _: expert_policy(env, noise=0.0))
  figures = play_held_out(env, player, None, episodes=32, seed=0)
  assert figures["successes"] >= 31


def play(env, disturb: Callable[[int, PhysicsState], PhysicsState]) -> int:
  """Worlds, of 16, that the expert solves in one episode; the state before each period
  goes through ``disturb``."""
  step = jax.jit(lambda s, key: env.step(s, env.expert_action(s), key))
  state = jax.jit(env.reset)(jnp.arange(16))
  solved, over = np.zeros(16, bool), np.zeros(16, bool)
  for t in range(env.config.episode_steps):
    state = step(state.replace(physics=disturb(t, state.physics)), jax.random.key(t))
    solved |= ~over & np.asarray(state.timestep.terminated)
    over |= np.asarray(state.timestep.last)
  return solved.sum()


def test_the_expert_recovers_when_the_object_is_pushed_away(env):
  """It is moved aside while the arm approaches."""
  if env.task.name not in PUSHED:
    pytest.skip("a holder is in the way, or a task of your own")
  body, far = PUSHED[env.task.name]
  address, _ = env.task.scene.free_joint(body)
  aside = jnp.asarray([far, -far]) / np.sqrt(2)

  def push(t: int, physics: PhysicsState) -> PhysicsState:
    if t != 8:
      return physics
    qpos = physics.qpos.at[:, address : address + 2].add(aside)
    return physics.replace(qpos=qpos)

  assert play(env, push) >= 15


def test_the_expert_recovers_when_the_object_swings_in_the_hand(env):
  if env.task.name not in SWUNG:
    pytest.skip("nothing is carried, or a task of your own")
  body, period, height = SWUNG[env.task.name]
  address, dof = env.task.scene.free_joint(body)

  def swing(t: int, physics: PhysicsState) -> PhysicsState:
    if t != period:
      return physics
    assert (physics.qpos[:, address + 2] > height).mean() > 0.8  # Lifted.
    return physics.replace(qvel=physics.qvel.at[:, dof + 3 : dof + 6].add(3.0))

  assert play(env, swing) >= 15
