"""Cameras of the environment: which geoms cast and receive shadows."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras, shadows_of_the_hand
from apnpql_jax.render import CameraSpec, Geoms, Lighting, render
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.scene import load_scene
from apnpql_jax.tasks import make_task, task_names

HAND = {"hand", "d435", "r1", "l1", "r_tip", "l_tip", "r_pad", "l_pad"}


@pytest.mark.parametrize("name", task_names())
def test_the_whole_hand_casts_a_shadow(name):
  scene = make_task(name).scene
  found = shadows_of_the_hand(scene, Geoms.from_model(scene.model))
  assert {scene.model.geom(i).name for i in found["shadow_casters"]} == HAND
  assert scene.model.geom("table").id in found["shadow_receivers"]


@pytest.mark.parametrize("mocap", [False, True])
def test_a_flat_mark_on_a_body_without_joints_receives_the_shadow(mocap):
  def add(spec: mujoco.MjSpec) -> None:
    stand = spec.worldbody.add_body(mocap=mocap).add_body()
    stand.add_geom(name="mat", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.0005])

  scene = load_scene(mjcf_path("push_plate"), variants=[add])
  found = shadows_of_the_hand(scene, Geoms.from_model(scene.model))
  names = {scene.model.geom(i).name for i in found["shadow_receivers"]}
  assert names == {"table", "goal", "mat"}


def test_the_shadow_falls_only_on_the_table_and_flat_marks(task, resets):
  scene = task.scene
  poses = make_kinematics(scene)(resets)
  plain, shaded = (
    np.asarray(make_cameras(EnvConfig(shadows=shadows), scene)[0](poses), np.int32)
    for shadows in (False, True)
  )
  camera = CameraSpec.from_model(scene.model, "global", height=72, width=96)
  geom = render(
    Geoms.from_model(scene.model),
    camera,
    poses.geom_xpos,
    poses.geom_xmat,
    poses.cam_xpos[:, camera.id],
    poses.cam_xmat[:, camera.id],
    outputs=("segmentation",),
  ).segmentation
  dark = (plain != shaded).any(-1)
  flat = [scene.model.geom(name).id for name in ("table", "goal")]
  assert np.isin(geom, flat)[dark].all()
  assert (dark.sum((1, 2)) > 20).mean() > 0.5
  left = 1.0 - Lighting().shadow
  np.testing.assert_allclose(shaded[dark], left * plain[dark], atol=1.5)
