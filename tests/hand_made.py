"""States made by hand, bodies, pads and tool put where a test wants them, and what
tests ask of states that are drawn."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from apnpql_jax.render import CameraSpec, Geoms, render
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.tasks import Task
from apnpql_jax.tasks.flip_cup import SHAPES
from apnpql_jax.tasks.pinch import finger_angle

WORLDS = 16
"""Batch size of the shared fixtures: one size, one compilation."""

SLOW_MJX = ["native", pytest.param("mjx", marks=pytest.mark.slow)]
"""Both engines, where MJX takes minutes."""

MOTIONS = [
  (dof, sign * limit * factor, factor < 1)
  for dof, limit in enumerate([0.05] * 3 + [0.5] * 3)
  for sign, factor in ((1, 0.8), (1, 1.2), (-1, 1.2))
]
"""Degree of freedom of a free body, its speed in m/s or rad/s, whether that is rest."""


def drawn(task: Task, worlds: int, *, seed: int = 3) -> PhysicsState:
  """Initial states as the task draws them."""
  draw = task.sample_resets(np.random.default_rng(seed), worlds)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw))


def each_cup(task: Task, worlds: int) -> tuple[PhysicsState, np.ndarray]:
  """Initial states of flip_cup with its shapes in turn, and half of the width and the
  height of the cups, f64[worlds, 2], m."""
  draw = task.sample_resets(np.random.default_rng(0), worlds)
  variant = np.arange(worlds) % len(SHAPES)
  half = np.array(SHAPES)[variant, 1:] / [1, 2]
  address, _ = task.scene.free_joint("cup")
  draw.qpos[:, address + 2] = half[:, 1]
  draw = draw._replace(variant=variant)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw)), half


def neutral_tool(task: Task) -> tuple[np.ndarray, np.ndarray]:
  """Position f64[3] and rotation f64[3, 3] at the keyframe, from C MuJoCo."""
  data = mujoco.MjData(task.scene.model)
  mujoco.mj_resetDataKeyframe(task.scene.model, data, 0)
  mujoco.mj_kinematics(task.scene.model, data)
  tool = data.site("tool")
  return tool.xpos.copy(), tool.xmat.reshape(3, 3).copy()


def pos(task: Task, state: PhysicsState, body: str):
  """f32[worlds, 3] of a free body."""
  address, _ = task.scene.free_joint(body)
  return state.qpos[:, address : address + 3]


def rotation(task: Task, state: PhysicsState, body: str) -> Rotation:
  """Of a free body, one per world."""
  address, _ = task.scene.free_joint(body)
  quat = np.asarray(state.qpos[:, address + 3 : address + 7], np.float64)
  return Rotation.from_quat(quat, scalar_first=True)


def put(
  task: Task, state: PhysicsState, body: str, where=None, turn: Rotation | None = None
) -> PhysicsState:
  """Moves a free body to ``where`` and gives it the rotation ``turn``, if stated."""
  address, _ = task.scene.free_joint(body)
  qpos = state.qpos
  if where is not None:
    qpos = qpos.at[:, address : address + 3].set(jnp.asarray(where))
  if turn is not None:
    quat = turn.as_quat(scalar_first=True)
    qpos = qpos.at[:, address + 3 : address + 7].set(quat)
  return state.replace(qpos=qpos)


def moving(
  task: Task, state: PhysicsState, body: str, dof: int, speed: float
) -> PhysicsState:
  """Gives a free body a speed; see ``MOTIONS``."""
  _, start = task.scene.free_joint(body)
  return state.replace(qvel=state.qvel.at[:, start + dof].set(speed))


def with_gap(task: Task, state: PhysicsState, gap) -> PhysicsState:
  """The pads are ``gap`` m apart: a number, or f64[worlds]."""
  fingers = [task.scene.model.joint(f"finger_{x}") for x in ("r1", "r2", "l1", "l2")]
  address = np.array([finger.qposadr[0] for finger in fingers])
  angle = jnp.broadcast_to(finger_angle(gap), len(state.qpos))[:, None]
  return state.replace(qpos=state.qpos.at[:, address].set(angle))


def tool_at(task: Task, kinematics: Kinematics, where, mat=None) -> Kinematics:
  """The tool at ``where`` and, if stated, with the rotation ``mat``."""
  tool = task.scene.tool_site
  kinematics = kinematics.replace(site_xpos=kinematics.site_xpos.at[:, tool].set(where))
  if mat is None:
    return kinematics
  return kinematics.replace(site_xmat=kinematics.site_xmat.at[:, tool].set(mat))


def segmentation(
  scene: Scene, kinematics: Kinematics, size: tuple[int, int] = (72, 96)
) -> np.ndarray:
  """Ids of the geoms that the camera over the table sees, i32[worlds, H, W]."""
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
  return np.asarray(image.segmentation)


def assert_uniform(values, low, high) -> None:
  """Every column of ``values`` f64[n, ...] is uniform between ``low`` and ``high``."""
  share = (values - low) / (np.asarray(high) - low)
  assert share.min() >= 0 and share.max() <= 1
  for column in share.reshape(len(share), -1).T:
    assert stats.kstest(column, "uniform").pvalue > 1e-3


def assert_pairs_are_uniform(pairs, low, high, *, distance, least) -> None:
  """Pairs f64[n, 4] are uniform where the spots of one are far enough apart.

  Compared with pairs that are drawn here, as many as it takes.

  Args:
    pairs: two spots each, in any coordinates.
    low: of the coordinates of a spot.
    high: of the same.
    distance: pairs -> f64[n], how far apart their spots are.
    least: how far they have to be.
  """
  low, high = np.tile(np.stack([low, high]), 2)
  assert (pairs >= low - 1e-9).all() and (pairs <= high + 1e-9).all()
  assert least <= distance(pairs).min() < least + 0.01
  drawn = np.random.default_rng(1).uniform(low, high, (40000, 4))
  drawn = drawn[distance(drawn) >= least]
  for actual, expected in zip(
    (*pairs.T, distance(pairs)), (*drawn.T, distance(drawn)), strict=True
  ):
    assert stats.ks_2samp(actual, expected).pvalue > 1e-3


def apart(pairs: np.ndarray) -> np.ndarray:
  """Distances f64[n] between the spots x, y of pairs f64[n, 4]."""
  return np.linalg.norm(pairs[:, :2] - pairs[:, 2:], axis=-1)
