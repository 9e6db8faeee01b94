"""Static targets: where they lead, and that they suffice to solve a task."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs import static_targets
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.primitives.reset_bank import ResetBank
from apnpql_jax.tasks.push_plate import DRAG_HEIGHT, GOAL_TOLERANCE, INSIDE

ROWS = 12
CONFIG = EnvConfig(obs="state", backend="native", worlds=16, bank_rows=256)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def static(env: Env) -> ResetBank:
  """Returns twelve rows of the bank, played eight at a time."""
  bank = jax.tree.map(lambda x: x[:ROWS], env._bank)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(static_targets, "AT_ONCE", 8)
    return static_targets.with_static_targets(bank, env)


def test_they_lead_to_the_plate_and_to_the_goal(env, static):
  """By MuJoCo's kinematics. The tool drags the plate by its rim, so it ends ahead."""
  model = env.task.scene.model
  data = mujoco.MjData(model)
  plate, _ = env.task.scene.free_joint("plate")
  goal = env.task.scene.mocap("goal")
  for row in range(ROWS):
    tools = []
    for angles in np.asarray(static.targets[row]):
      data.qpos[env.task.scene.arm_qpos] = angles
      mujoco.mj_kinematics(model, data)
      tools.append(data.site_xpos[env.task.scene.tool_site].copy())
    at_object, at_goal, _ = tools
    start = static.qpos[row, plate : plate + 2]
    np.testing.assert_allclose(at_object[:2], start, atol=0.01)
    np.testing.assert_allclose([at_object[2], at_goal[2]], DRAG_HEIGHT, atol=0.01)
    ahead = np.linalg.norm(at_goal[:2] - static.mocap_pos[row, goal, :2])
    assert ahead < INSIDE + GOAL_TOLERANCE
  np.testing.assert_array_equal(static.targets[:, 2], env._bank.targets[:ROWS, 2])


def test_straight_to_the_plate_and_straight_to_the_goal_solves_most(env, static):
  worlds = Env(dataclasses.replace(CONFIG, static_targets=True), env.task, static)
  rows, step = jnp.arange(ROWS), jax.jit(worlds.step)
  state, dragging = worlds.reset(rows), jnp.zeros(ROWS, bool)
  solved, over = np.zeros(ROWS, bool), np.zeros(ROWS, bool)
  while not over.all():
    q = state.physics.qpos[:, env.task.scene.arm_qpos]
    dragging |= jnp.abs(q - static.targets[:, 0]).max(axis=-1) < 0.03
    action = state.timestep.primitives[rows, dragging.astype(int)]
    state = step(state, action, jax.random.key(0))
    solved |= np.asarray(state.timestep.terminated) & ~over
    over |= np.asarray(state.timestep.last)
  assert solved.mean() > 0.5
