"""Worlds of one batch with different models: both engines, kinematics, images."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import render_oracles

from apnpql_jax.presets import mjcf_path
from apnpql_jax.render import CameraSpec, Geoms, render
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import flip_cup, make_task

WORLDS = 6


@pytest.fixture(scope="module")
def task():
  return make_task("flip_cup")


@pytest.fixture(scope="module")
def models(task) -> list[mujoco.MjModel]:
  """The variants, compiled here, apart from the code under test."""
  models = []
  for shape in flip_cup.SHAPES:
    spec = mujoco.MjSpec.from_file(str(mjcf_path("flip_cup")))
    flip_cup.shape_cup(spec, *shape)
    models.append(spec.compile())
  return models


@pytest.fixture(scope="module")
def state(task) -> physics.PhysicsState:
  """Cups of all shapes, twice: spinning high in the air, and just above the table."""
  draw = task.sample_resets(np.random.default_rng(0), WORLDS)
  variant = np.arange(WORLDS) % len(flip_cup.SHAPES)
  address, dof = task.scene.free_joint("cup")
  heights = np.array(flip_cup.SHAPES)[variant, 2] / 2
  draw.qpos[:, address + 2] = heights + np.repeat([0.2, 0.002], 3)
  draw = draw._replace(variant=variant)
  state = physics.initial_state(task.scene, *map(jnp.asarray, draw))
  return state.replace(qvel=state.qvel.at[:3, dof + 3 : dof + 6].set([2.0, 0.0, 2.0]))


@pytest.fixture(scope="module", params=["native", "mjx"])
def moved(request, task, state) -> np.ndarray:
  """Pose of the cups after 0.15 s, f32[WORLDS, 7]."""
  engine = physics.make_physics(request.param, task.scene, substeps=30)
  after = jax.jit(engine.step)(state, jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS))
  address, _ = task.scene.free_joint("cup")
  return np.asarray(after.qpos)[:, address : address + 7]


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


def test_each_world_is_seen_in_its_own_shape(task, models, state):
  kinematics = jax.jit(make_kinematics(task.scene))(state)
  scene, size = task.scene, (72, 96)
  camera = scene.id("camera", "global")
  image = render(
    Geoms.from_model(scene.model),
    CameraSpec.from_model(scene.model, "global", height=size[0], width=size[1]),
    kinematics.geom_xpos,
    kinematics.geom_xmat,
    kinematics.cam_xpos[:, camera],
    kinematics.cam_xmat[:, camera],
    fields=kinematics.fields,
    outputs=("segmentation",),
  )
  for world in range(WORLDS):
    model = models[world % len(models)]
    data = mujoco.MjData(model)
    data.qpos[:] = np.asarray(state.qpos[world])
    data.mocap_pos[:] = np.asarray(state.mocap_pos[world])
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(kinematics.geom_xpos[world], data.geom_xpos, atol=2e-6)
    expected = render_oracles.cast_rays(model, data, "global", *size)[0]
    # The boxes of a cup share their tops, where either may be seen.
    walls = [model.geom(f"cup_{i}").id for i in range(4)]
    seen = np.asarray(image.segmentation[world])
    same = (seen == expected) | (np.isin(seen, walls) & np.isin(expected, walls))
    assert np.isin(expected, walls).sum() > 60
    assert (~same).sum() <= 3  # Rays along an edge, in single precision.
