"""Every task's scripted expert on real physics: held-out episodes, a disturbance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config import EnvConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.evaluate import make_player, play_held_out
from apnpql_jax.rollout import expert_policy
from apnpql_jax.tasks import task_names

ROWS = 128
DISTURBED = {
  "flip_cup": "cup",
  "place_plate": "plate",
  "push_plate": "plate",
  "stack_box": "yellow",
}


@pytest.fixture(scope="module", params=task_names())
def env(request) -> Env:
  return make_env(
    EnvConfig(task=request.param, obs="state", backend="native", bank_rows=ROWS)
  )


def test_the_expert_solves_its_task(env):
  play = make_player(env, lambda _: expert_policy(env, noise=0.0))
  figures = play_held_out(env, play, None, episodes=32, seed=0)
  assert figures["successes"] >= 31


def test_the_expert_recovers_from_a_disturbance(env):
  """The object jumps by 2 cm while the arm approaches, or, where a holder would be in
  the way, swings at 3 rad/s in the hand."""
  worlds, name = 16, env.task.name
  if name not in DISTURBED:
    pytest.skip("a task of your own")
  address, dof = env.task.scene.free_joint(DISTURBED[name])
  in_hand = name == "place_plate"
  step = jax.jit(lambda s, key: env.step(s, env.expert_action(s), key))
  state = jax.jit(env.reset)(jnp.arange(worlds))
  solved, over = np.zeros(worlds, bool), np.zeros(worlds, bool)
  for t in range(env.config.episode_steps):
    physics = state.physics
    if in_hand and t == 28:
      assert (physics.qpos[:, address + 2] > 0.08).mean() > 0.8  # Lifted.
      qvel = physics.qvel.at[:, dof + 3 : dof + 6].add(3.0)
      state = state.replace(physics=physics.replace(qvel=qvel))
    if not in_hand and t == 8:
      qpos = physics.qpos.at[:, address : address + 2].add(jnp.asarray([0.014, -0.014]))
      state = state.replace(physics=physics.replace(qpos=qpos))
    state = step(state, jax.random.key(t))
    solved |= ~over & np.asarray(state.timestep.terminated)
    over |= np.asarray(state.timestep.last)
  assert solved.sum() >= worlds - 1
