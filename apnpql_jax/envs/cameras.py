"""The cameras of a scene as functions from poses to images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import CameraSpec, Geoms, Lighting, render
from apnpql_jax.render.shadow import SHADOWS
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.scene import Scene, fixed_bodies
from apnpql_jax.types import Array

FLAT = 0.002  # m; thinner geoms are marks on the table and receive shadows as it does

VIEW_SIZE = (506, 674)
"""Height and width of the view of the robot, from the camera "wide", in pixels. Next to
it fit the global camera's image enlarged four times and the wrist's six times."""

Renderer = Callable[[Kinematics], Array]


def make_cameras(config: EnvConfig, scene: Scene) -> tuple[Renderer, Renderer]:
  """Returns the agent's global and wrist camera, or raises ``ConfigError``."""
  return (
    camera_renderer(config, scene, "global", config.global_size),
    camera_renderer(config, scene, "wrist", config.wrist_size),
  )


def camera_renderer(
  config: EnvConfig, scene: Scene, name: str, size: tuple[int, int]
) -> Renderer:
  """Returns ``f(kinematics) -> u8[*b, H, W, 3]`` for a camera of the scene."""
  index = scene.id("camera", name)
  height, width = size
  spec = CameraSpec.from_model(scene.model, name, height=height, width=width)
  geoms = Geoms.from_model(scene.model)
  shadows = shadows_of_the_hand(scene, geoms) if config.shadows else {}
  lighting = Lighting.from_model(scene.model, **shadows)

  def renderer(kinematics: Kinematics) -> Array:
    camera = kinematics.cam_xpos[..., index, :], kinematics.cam_xmat[..., index, :, :]
    poses = kinematics.geom_xpos, kinematics.geom_xmat, *camera
    fields = kinematics.fields
    return render(geoms, spec, *poses, lighting, fields=fields, outputs=("rgb",)).rgb

  return renderer


def shadows_of_the_hand(scene: Scene, geoms: Geoms) -> dict[str, Any]:
  """Returns the ``Lighting`` settings for the hand's shadow on table and flat marks."""
  model = scene.model
  body, kind = model.geom_bodyid[geoms.ids], geoms.types
  casts = in_hand(scene)[geoms.ids] & np.isin(kind, list(SHADOWS))
  # What cannot move by itself, and is flat, receives the shadow.
  root = model.body_weldid[body]
  still = fixed_bodies(model)[root] | (model.body_mocapid[root] >= 0)
  shapes = mujoco.mjtGeom
  half_height = np.select(
    [kind == shapes.mjGEOM_BOX, kind == shapes.mjGEOM_CYLINDER],
    [geoms.sizes[:, 2], geoms.sizes[:, 1]],
    np.where(kind == shapes.mjGEOM_PLANE, 0.0, np.inf),
  )
  receives = still & (2 * half_height < FLAT)
  casters, receivers = (tuple(geoms.ids[x].tolist()) for x in (casts, receives))
  return {"shadow_casters": casters, "shadow_receivers": receivers}


def in_hand(scene: Scene) -> np.ndarray:
  """Returns which geoms belong to the gripper, bool[ngeom]."""
  model, hand = scene.model, scene.id("body", "gripper")
  bodies = np.zeros(model.nbody, bool)
  for body in range(hand, model.nbody):  # Parents have lower ids.
    bodies[body] = body == hand or bodies[model.body_parentid[body]]
  return bodies[model.geom_bodyid]
