"""States with bodies, pads and tool in given poses, and checks of drawn states."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.ranges import RandomizationConfig
from apnpql_jax.randomization.randomize import make_randomize
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
"""Degree of freedom of a free body, speed in m/s or rad/s, whether that is rest."""


def painted(folder: Path) -> Path:
  """Writes push_plate's scene with a material, a texture and a checker to a file."""
  plate = 'size="0.083 0.003" rgba="0.12 0.30 0.80 1"'
  added = """
    <asset>
      <texture name="shade" type="cube" builtin="gradient" rgb1="1 0.4 0.2"
               rgb2="0.6 0.2 0.4" width="64" height="64"/>
      <texture name="squares" type="2d" builtin="checker" rgb1="0.8 0.8 0.2"
               rgb2="0.5 0.2 0.8" width="64" height="64"/>
      <material name="plain" rgba="0.9 0.1 0.1 1"/>
      <material name="shade" texture="shade" rgba="0.8 0.8 0.8 1"/>
      <material name="squares" texture="squares" texuniform="true" texrepeat="20 20"/>
    </asset>
    <worldbody>
      <geom name="crate" type="box" size="0.1 0.1 0.1" pos="0.7 0 0.1"
            material="shade"/>
      <geom name="mat" type="plane" size="0.1 0.1 1" pos="0.5 0.25 0.002"
            material="squares"/>
    </worldbody>"""
  text = mjcf_path("push_plate").read_text()
  assert plate in text
  text = text.replace(plate, 'size="0.083 0.003" material="plain"')
  path = folder / "painted.xml"
  path.write_text(text.replace("</mujoco>", f"{added}</mujoco>"))
  return path


def drawn(task: Task, worlds: int, *, seed: int = 3) -> PhysicsState:
  """Draws initial states of a task."""
  draw = task.sample_resets(np.random.default_rng(seed), worlds)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw))


def randomized(
  scene: Scene, config: RandomizationConfig, qpos: np.ndarray | None = None
) -> PhysicsState:
  """Returns eight randomized worlds of a scene, from qpos[8, nq] or the keyframe."""
  qpos = np.tile(scene.keyframe("neutral"), (8, 1)) if qpos is None else qpos
  mocap = np.zeros((8, scene.model.nmocap, 7))
  draw = qpos, mocap[..., :3], mocap[..., 3:], np.zeros(8, int)
  state = physics.initial_state(scene, *map(jnp.asarray, draw))
  keys = jax.random.split(jax.random.key(0), 8)
  return jax.jit(make_randomize(config, scene))(state, keys)


def each_cup(task: Task, worlds: int) -> tuple[PhysicsState, np.ndarray]:
  """Returns initial states of flip_cup with its shapes in turn.

  Also half the width and half the height of the cups, f64[worlds, 2], m.
  """
  draw = task.sample_resets(np.random.default_rng(0), worlds)
  variant = np.arange(worlds) % len(SHAPES)
  half = np.array(SHAPES)[variant, 1:] / [1, 2]
  address, _ = task.scene.free_joint("cup")
  draw.qpos[:, address + 2] = half[:, 1]
  draw = draw._replace(variant=variant)
  return physics.initial_state(task.scene, *map(jnp.asarray, draw)), half


def neutral_tool(task: Task) -> tuple[np.ndarray, np.ndarray]:
  """Returns the tool's position f64[3] and rotation f64[3, 3] at the keyframe."""
  data = mujoco.MjData(task.scene.model)
  mujoco.mj_resetDataKeyframe(task.scene.model, data, 0)
  mujoco.mj_kinematics(task.scene.model, data)
  tool = data.site("tool")
  return tool.xpos.copy(), tool.xmat.reshape(3, 3).copy()


def pos(task: Task, state: PhysicsState, body: str):
  """Returns the positions f32[worlds, 3] of a free body."""
  address, _ = task.scene.free_joint(body)
  return state.qpos[:, address : address + 3]


def rotation(task: Task, state: PhysicsState, body: str) -> Rotation:
  """Returns the rotations of a free body, one per world."""
  address, _ = task.scene.free_joint(body)
  quat = np.asarray(state.qpos[:, address + 3 : address + 7], np.float64)
  return Rotation.from_quat(quat, scalar_first=True)


def put(
  task: Task, state: PhysicsState, body: str, where=None, turn: Rotation | None = None
) -> PhysicsState:
  """Moves a free body to ``where`` and rotates it to ``turn``, if given."""
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
  """Sets the speed of a free body; see ``MOTIONS``."""
  _, start = task.scene.free_joint(body)
  return state.replace(qvel=state.qvel.at[:, start + dof].set(speed))


def with_gap(task: Task, state: PhysicsState, gap) -> PhysicsState:
  """Sets the gap between the pads, m: a number or f64[worlds]."""
  fingers = [task.scene.model.joint(f"finger_{x}") for x in ("r1", "r2", "l1", "l2")]
  address = np.array([finger.qposadr[0] for finger in fingers])
  angle = jnp.broadcast_to(finger_angle(gap), len(state.qpos))[:, None]
  return state.replace(qpos=state.qpos.at[:, address].set(angle))


def tool_at(task: Task, kinematics: Kinematics, where, mat=None) -> Kinematics:
  """Moves the tool to ``where`` and rotates it to ``mat``, if given."""
  tool = task.scene.tool_site
  kinematics = kinematics.replace(site_xpos=kinematics.site_xpos.at[:, tool].set(where))
  if mat is None:
    return kinematics
  return kinematics.replace(site_xmat=kinematics.site_xmat.at[:, tool].set(mat))


def segmentation(
  scene: Scene, kinematics: Kinematics, size: tuple[int, int] = (72, 96)
) -> np.ndarray:
  """Renders the ids of the geoms in the global camera, i32[worlds, H, W]."""
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
  """Checks that every column of f64[n, ...] is uniform between ``low`` and ``high``."""
  share = (values - low) / (np.asarray(high) - low)
  assert share.min() >= 0 and share.max() <= 1
  for column in share.reshape(len(share), -1).T:
    assert stats.kstest(column, "uniform").pvalue > 1e-3


def assert_pairs_are_uniform(pairs, low, high, *, distance, least) -> None:
  """Checks that pairs are uniform among those whose spots are far enough apart.

  The reference is drawn here by rejection.

  Args:
    pairs: f64[n, 4], two spots each, in any coordinates.
    low: lower limits of the coordinates of a spot.
    high: upper limits of the same.
    distance: maps pairs to the distances f64[n] between their spots.
    least: smallest distance allowed.
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
  """Returns the distances f64[n] between the spots x, y of pairs f64[n, 4]."""
  return np.linalg.norm(pairs[:, :2] - pairs[:, 2:], axis=-1)
