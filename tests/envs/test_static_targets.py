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
from apnpql_jax.tasks.stack_box import SIDE

ROWS = 12
BOXES = "yellow", "blue"
CONFIG = EnvConfig(obs="state", backend="native", worlds=16, bank_rows=256)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def static(env: Env) -> ResetBank:
  """Returns twelve rows of the bank."""
  return played(env)


def played(env: Env) -> ResetBank:
  """Returns twelve rows of a bank with static targets, played eight at a time."""
  bank = jax.tree.map(lambda x: x[:ROWS], env._bank)
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(static_targets, "AT_ONCE", 8)
    return static_targets.with_static_targets(bank, env)


def tools(env: Env, targets: jax.Array) -> np.ndarray:
  """Returns where the tool is at joint targets f32[3, 6], by MuJoCo; f64[3, 3], m."""
  model = env.task.scene.model
  data, found = mujoco.MjData(model), []
  for angles in np.asarray(targets):
    data.qpos[env.task.scene.arm_qpos] = angles
    mujoco.mj_kinematics(model, data)
    found.append(data.site_xpos[env.task.scene.tool_site].copy())
  return np.stack(found)


def test_they_lead_to_the_plate_and_to_the_goal(env, static):
  """The tool drags the plate by its rim, so it ends ahead."""
  plate, _ = env.task.scene.free_joint("plate")
  goal = env.task.scene.mocap("goal")
  for row in range(ROWS):
    at_object, at_goal, _ = tools(env, static.targets[row])
    start = static.qpos[row, plate : plate + 2]
    np.testing.assert_allclose(at_object[:2], start, atol=0.01)
    np.testing.assert_allclose([at_object[2], at_goal[2]], DRAG_HEIGHT, atol=0.01)
    ahead = np.linalg.norm(at_goal[:2] - static.mocap_pos[row, goal, :2])
    assert ahead < INSIDE + GOAL_TOLERANCE
  np.testing.assert_array_equal(static.targets[:, 2], env._bank.targets[:ROWS, 2])


def test_at_the_goal_the_hand_still_has_the_box():
  """The tool is as far from where the box ends as it was from where the box began."""
  env = make_env(dataclasses.replace(CONFIG, task="stack_box"))
  static, scene = played(env), env.task.scene
  yellow, blue = (slice(at, at + 3) for at, _ in map(scene.free_joint, BOXES))
  for row in range(ROWS):
    at_object, at_goal, _ = tools(env, static.targets[row])
    start, end = (
      static.qpos[row, yellow],
      static.qpos[row, blue] + np.array([0, 0, SIDE]),
    )
    np.testing.assert_allclose(at_goal - end, at_object - start, atol=0.01)


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
