"""Objects on hinges and slides: a drawer and a door, in physics and in recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax.data import demonstrations, recordings
from apnpql_jax.errors import FileError
from apnpql_jax.sim.engines import make_physics
from apnpql_jax.sim.names import ARM_JOINTS
from apnpql_jax.sim.physics import initial_state
from apnpql_jax.sim.scene import Scene, load_scene

ARENA = Path(__file__).resolve().parents[2] / "mjcf" / "arena.xml"
PERIOD_S, PERIODS = 0.15, 4

FURNITURE = """
<body name="drawer" pos="0.7 0 0.2">
  <joint name="drawer_slide" type="slide" axis="1 0 0" range="-0.2 0" damping="2"
    frictionloss="0.1"/>
  <geom type="box" size="0.1 0.1 0.03" mass="0.5"/>
</body>
<body name="door" pos="0.8 0.3 0.2">
  <joint name="door_hinge" type="hinge" axis="0 0 1" range="0 1.6" damping="0.01"
    stiffness="0.02"/>
  <geom type="box" size="0.1 0.01 0.1" pos="0.1 0 0" mass="0.3"/>
</body>"""


@pytest.fixture
def scene(tmp_path) -> Scene:
  return furnished(tmp_path, FURNITURE)


def furnished(folder: Path, furniture: str) -> Scene:
  path = folder / "kitchen.xml"
  path.write_text(
    f"""<mujoco><include file="{ARENA}"/><worldbody>{furniture}</worldbody></mujoco>"""
  )
  return load_scene(path)


def addresses(scene: Scene) -> list[int]:
  names = ("drawer_slide", "door_hinge")
  return [int(scene.model.joint(name).qposadr[0]) for name in names]


def alone(scene: Scene) -> np.ndarray:
  """Returns drawer and door f64[periods + 1, 2] in C MuJoCo, without the robot."""
  option = scene.model.opt
  text = f"""<mujoco><compiler angle="radian"/><worldbody>{FURNITURE}</worldbody>
    </mujoco>"""
  model = mujoco.MjModel.from_xml_string(text)
  for name in ("timestep", "integrator", "solver", "iterations", "tolerance", "cone"):
    setattr(model.opt, name, getattr(option, name))
  data = mujoco.MjData(model)
  data.qpos[:], data.qvel[:] = START
  steps = round(PERIOD_S / option.timestep)
  seen = [data.qpos.copy()]
  for _ in range(PERIODS):
    mujoco.mj_step(model, data, steps)
    seen.append(data.qpos.copy())
  return np.array(seen)


START = ([-0.15, 0.4], [0.35, 1.5])
"""Positions and velocities of drawer and door: both move, one reaches its limit."""


@pytest.mark.parametrize(
  "engine", ["native", pytest.param("mjx", marks=pytest.mark.slow)]
)
def test_drawer_and_door_move_as_in_c_mujoco(scene, engine):
  model, (slide, hinge) = scene.model, addresses(scene)
  qpos = np.asarray(model.qpos0, np.float32)[None].copy()
  qpos[0, scene.arm_qpos] = [-1.9, -1.77, 1.99, -1.79, -1.57, -0.32]
  qpos[0, [slide, hinge]] = START[0]
  none = jnp.zeros((1, 0, 3)), jnp.zeros((1, 0, 4))
  state = initial_state(scene, jnp.asarray(qpos), *none, jnp.zeros(1, jnp.int32))
  velocity = state.qvel.at[0, jnp.array([slide, hinge])].set(jnp.array(START[1]))
  state = state.replace(qvel=velocity)
  substeps = round(PERIOD_S / model.opt.timestep)
  step = jax.jit(make_physics(engine, scene, substeps=substeps).step)
  seen = [state.qpos]
  for _ in range(PERIODS):
    state = step(state, jnp.zeros((1, 6)), jnp.zeros(1))
    seen.append(state.qpos)
  found = np.stack(seen)[:, 0, [slide, hinge]]
  expected = alone(scene)
  assert np.ptp(expected, axis=0).min() > 0.05
  np.testing.assert_allclose(found, expected, atol=2e-4)


def recording(scene: Scene) -> dict[str, Any]:
  """Returns what was measured: every 50 ms, in mm and degrees."""
  coarse, time = PERIOD_S * np.arange(PERIODS + 1), np.arange(0, 0.61, 0.05)
  drawer, door = (np.interp(time, coarse, x) for x in alone(scene).T)
  n = len(time)
  rest = np.degrees([-1.9, -1.77, 1.99, -1.79, -1.57, -0.32])
  return {
    "time": time,
    "joints": np.tile(rest, (n, 1)),
    "gripper": np.zeros(n),
    "drawer_slide": 1000 * drawer,
    "door_hinge": np.degrees(door),
    "time_unit": "s",
    "angle_unit": "deg",
    "length_unit": "mm",
    "quaternion_order": "wxyz",
    "frame": "world",
    "joint_names": np.array(ARM_JOINTS),
    "gripper_range": np.array([0.0, 1.0]),
  }


def convert(folder: Path, scene: Scene, arrays: dict[str, Any]):
  np.savez(folder / "recording.npz", **arrays)
  return recordings.convert(folder / "recording.npz", scene, period_s=PERIOD_S)


def test_a_recording_moves_drawer_and_door(scene, tmp_path):
  demos = convert(tmp_path, scene, recording(scene))
  demonstrations.check(demos, scene)
  found = demos.qpos[:, addresses(scene)]
  np.testing.assert_allclose(found, alone(scene), atol=1e-6)
  dofs = [int(scene.model.joint(x).dofadr[0]) for x in ("drawer_slide", "door_hinge")]
  speed = np.diff(alone(scene), axis=0) / PERIOD_S
  np.testing.assert_allclose(demos.qvel[:-1, dofs], speed, atol=1e-5)


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"door_hinge": None}, "lacks the positions of the joints door_hinge, from which"),
    ({"drawer_slide": np.zeros((13, 1))}, r"drawer_slide is float64\[13, 1\]"),
    ({"length_unit": "m"}, "qpos is beyond the limit of a joint"),
    ({"angle_unit": "rad"}, "qpos is beyond|rad/s"),
    ({"cupboard": np.zeros(13)}, "unknown arrays: cupboard"),
  ],
)
def test_wrong_columns_are_refused_by_name(scene, tmp_path, change, words):
  arrays = recording(scene) | change
  arrays = {name: x for name, x in arrays.items() if x is not None}
  with pytest.raises(FileError, match=words) as error:
    convert(tmp_path, scene, arrays)
  assert "\n" not in str(error.value)


@pytest.mark.parametrize(
  ("joint", "words"),
  [
    ('<joint type="slide"/>', "kitchen.xml: joint '' of lid needs a name of its own"),
    ('<joint name="time" type="hinge"/>', "joint 'time' of lid needs a name"),
    ('<joint name="lid" type="ball"/>', "joint 'lid' of lid is a ball joint"),
  ],
)
def test_a_joint_that_a_recording_cannot_have_is_named(tmp_path, joint, words):
  body = f'<body name="lid" pos="0.7 0 0.5">{joint}<geom size="0.05" mass="1"/></body>'
  scene = furnished(tmp_path, body)
  with pytest.raises(FileError, match=words):
    convert(tmp_path, scene, {})


def test_a_body_without_a_name_is_refused(tmp_path):
  """As `replicate` may make them."""
  one = '<body pos="0.6 0 0.1"><freejoint/><geom size="0.02" mass="1"/></body>'
  scene = furnished(
    tmp_path, f'<replicate count="2" offset="0.1 0 0">{one}</replicate>'
  )
  with pytest.raises(FileError, match="a body of the scene .* has no name"):
    convert(tmp_path, scene, {})
