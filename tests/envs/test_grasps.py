"""Objects do not slip in the hand and do not move on the table."""

from __future__ import annotations

from hand_made import SLOW_MJX
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.sim import physics
from apnpql_jax.tasks import task_names

WORLDS = 16
OBJECTS = {"flip_cup": "cup", "place_plate": "plate", "stack_box": "yellow"}


@pytest.fixture(scope="module", params=SLOW_MJX)
def backend(request) -> str:
  return request.param


@pytest.fixture(scope="module", params=task_names())
def env(request, backend) -> Env:
  return make_env(
    EnvConfig(task=request.param, obs="state", backend=backend, bank_rows=128)
  )


def pose(state: physics.PhysicsState, address: int) -> tuple[np.ndarray, Rotation]:
  """Returns positions f64[worlds, 3] and rotations of a free body."""
  qpos = np.asarray(state.qpos[:, address : address + 7], np.float64)
  return qpos[:, :3], Rotation.from_quat(qpos[:, 3:], scalar_first=True)


@pytest.mark.parametrize("env", sorted(OBJECTS), indirect=True, scope="module")
def test_a_carried_object_does_not_slip(env):
  """From the first instant in the air until the hand opens: lift, carry, flip."""
  address, _ = env.task.scene.free_joint(OBJECTS[env.task.name])
  site = env.task.scene.tool_site

  state = env.reset(jnp.arange(WORLDS))
  start = pose(state.physics, address)[0][:, 2]
  first: list[tuple | None] = [None] * WORLDS
  over = np.zeros(WORLDS, bool)
  slip, turn, carried = np.zeros(WORLDS), np.zeros(WORLDS), np.zeros(WORLDS, int)
  solved = np.zeros(WORLDS, bool)
  for t in range(env.config.episode_steps):
    where, rotation = pose(state.physics, address)
    action, kinematics = env.expert_action(state), env._kinematics(state.physics)
    state = env.step(state, action, jax.random.key(t))
    tool = np.asarray(kinematics.site_xpos[:, site], np.float64)
    hand = Rotation.from_matrix(np.asarray(kinematics.site_xmat[:, site], np.float64))
    place, turned = hand.inv().apply(where - tool), hand.inv() * rotation
    in_air = (where[:, 2] > start + 0.01) & (np.asarray(action[:, 6]) > 0) & ~over
    for world in np.flatnonzero(in_air):
      here = place[world], turned[world]
      first[world] = first[world] or here
      slip[world] = max(slip[world], np.linalg.norm(here[0] - first[world][0]))
      turn[world] = max(turn[world], (here[1] * first[world][1].inv()).magnitude())
      carried[world] += 1
    solved |= ~over & np.asarray(state.timestep.terminated)
    over |= np.asarray(state.timestep.last)
    if over.all():
      break
  assert (carried > 5).all() and solved.all()  # All the way, including half a turn.
  assert slip.max() < 0.002
  assert np.degrees(turn.max()) < 1.0


def test_objects_on_the_table_do_not_move(env):
  """Three seconds with the arm at rest: no drift, no jitter, nothing sinks."""
  state = start = env.reset(jnp.arange(WORLDS)).physics
  step = jax.jit(env.physics.step)
  model = env.task.scene.model
  free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
  if not free.size:
    pytest.skip("a user's task without free bodies")
  speeds = model.jnt_dofadr[free, None] + np.arange(6)
  for _ in range(20):
    state = step(state, jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS))
    assert np.abs(state.qvel[:, speeds]).max() < 0.1
  for address in model.jnt_qposadr[free]:
    (where, rotation), (later, turned) = pose(start, address), pose(state, address)
    assert np.abs(later - where).max() < 1e-3
    assert (turned * rotation.inv()).magnitude().max() < 0.01
