"""Worlds of one batch with different models: both engines, kinematics, images."""

from __future__ import annotations

from hand_made import SLOW_MJX, each_cup, pos, put, segmentation
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import render_oracles

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.sim import engines, physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import flip_cup, make_task

WORLDS = 6


@pytest.fixture(scope="module")
def task():
  return make_task("flip_cup")


@pytest.fixture(scope="module")
def models(task) -> list[mujoco.MjModel]:
  """Returns the variants, compiled independently of the code under test."""
  models = []
  for shape in flip_cup.SHAPES:
    spec = mujoco.MjSpec.from_file(str(mjcf_path("flip_cup")))
    flip_cup.shape_cup(spec, *shape)
    models.append(spec.compile())
  return models


@pytest.fixture(scope="module")
def state(task) -> physics.PhysicsState:
  """Returns cups of all shapes, spinning high in the air, then just above the table."""
  state, _ = each_cup(task, WORLDS)
  _, dof = task.scene.free_joint("cup")
  raised = pos(task, state, "cup").at[:, 2].add(np.repeat([0.2, 0.002], 3))
  state = put(task, state, "cup", raised)
  return state.replace(qvel=state.qvel.at[:3, dof + 3 : dof + 6].set([2.0, 0.0, 2.0]))


@pytest.fixture(scope="module", params=["native", "mjx"])
def fall(request, task, state):
  """Returns the poses of the cups after 0.15 s with the arm at rest, f32[WORLDS, 7].

  Compiled ahead of time, so that inputs which need another compilation are an error.
  """
  engine = engines.make_physics(request.param, task.scene, substeps=30)
  address, _ = task.scene.free_joint("cup")

  @jax.jit
  def fall(state: physics.PhysicsState) -> jax.Array:
    after = engine.step(state, jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS))
    return after.qpos[:, address : address + 7]

  return fall.lower(state).compile()


@pytest.fixture(scope="module")
def moved(state, fall) -> np.ndarray:
  return np.asarray(fall(state))


def test_each_cup_spins_with_its_own_inertia(task, models, state, moved):
  address, _ = task.scene.free_joint("cup")
  for world in range(len(models)):
    errors = []
    for model in models:
      data = mujoco.MjData(model)
      data.qpos[:], data.qvel[:] = state.qpos[world], state.qvel[world]
      for _ in range(30):
        mujoco.mj_step(model, data)
      error = moved[world, 2:] - data.qpos[address + 2 : address + 7]
      errors.append(np.abs(error).max())
    # The engines integrate gyroscopic torques differently, by much less than the
    # shapes differ.
    assert errors[world] < 2e-4
    assert min(np.delete(errors, world)) > 4e-4


def test_each_cup_stands_on_its_own_height(moved):
  heights = np.array(flip_cup.SHAPES)[:, 2] / 2
  np.testing.assert_allclose(moved[3:, 2], heights, atol=1e-3)


def test_worlds_change_their_shapes_without_recompilation(state, fall, moved):
  """Each world takes the state and the shape of its neighbor."""
  after = fall(jax.tree.map(lambda x: jnp.roll(x, 1, axis=0), state))
  np.testing.assert_allclose(after, np.roll(moved, 1, axis=0), atol=1e-6)


@pytest.fixture(scope="module", params=SLOW_MJX)
def env(request) -> Env:
  """Returns an environment with episodes of two periods."""
  return make_env(
    EnvConfig(
      task="flip_cup",
      obs="state",
      backend=request.param,
      bank_rows=128,
      time_limit_s=0.3,
    )
  )


def test_every_reset_draws_a_shape_without_recompilation(env):
  worlds = 16
  state = env.reset(jnp.arange(worlds))
  still, points, fresh = jnp.zeros((worlds, 7)), [], []
  # Compiled ahead of time: inputs which need another compilation are an error.
  env_step = jax.jit(env.step).lower(state, still, jax.random.key(0)).compile()
  for t in range(9):
    cup, *_, corner = np.split(np.asarray(env.task.objects(state.physics)), 4, axis=1)
    points.append(np.stack([cup[:, 2], *(corner - cup)[:, [0, 2]].T], axis=-1))
    fresh.append(np.asarray(state.elapsed) == 0)
    state = env_step(state, still, jax.random.key(t))
  # The cup's height over the table, half of its width and half of its height.
  (height, *size), fresh = np.moveaxis(np.stack(points), -1, 0), np.stack(fresh)
  np.testing.assert_allclose(height, size[1], atol=1e-3)
  shape = np.abs(size[1][..., None] - np.array(flip_cup.SHAPES)[:, 2] / 2).argmin(-1)
  shapes = np.array(flip_cup.SHAPES)[shape]
  np.testing.assert_allclose(np.stack(size, -1), shapes[..., 1:] / [1, 2], atol=1e-7)
  changed = np.diff(shape, axis=0) != 0
  assert not changed[~fresh[1:]].any()
  assert 0.3 < changed[fresh[1:]].mean() < 1.0
  assert fresh.sum(0).tolist() == [3] * worlds


def test_each_world_is_rendered_with_its_own_shape(task, models, state):
  kinematics = make_kinematics(task.scene)(state)
  size = (72, 96)
  image = segmentation(task.scene, kinematics, size)
  for world in range(WORLDS):
    model = models[world % len(models)]
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(state.qpos[world])
    data.mocap_pos[:] = np.asarray(state.mocap_pos[world])
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(kinematics.geom_xpos[world], data.geom_xpos, atol=2e-6)
    expected = render_oracles.cast_rays(model, data, "global", *size)[0]
    # The boxes of a cup overlap at their tops, where either may be hit.
    walls = [model.geom(f"cup_{i}").id for i in range(4)]
    same = image[world] == expected
    same |= np.isin(image[world], walls) & np.isin(expected, walls)
    assert np.isin(expected, walls).sum() > 60
    assert (~same).sum() <= 3  # Rays along an edge, in single precision.
