"""The arm in the shipped MJCF against published kinematics and dynamics."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.sim import arm

ORACLE = json.loads((Path(__file__).parent / "ur5e_oracle.json").read_text())
POSES = sorted(ORACLE["poses"])


@pytest.fixture(scope="module")
def bare_arm() -> tuple[mujoco.MjModel, mujoco.MjData]:
  """Returns the shipped scene without the gripper, like the published model."""
  spec = mujoco.MjSpec.from_file(str(mjcf_path("push_plate")))
  spec.delete(spec.body("gripper"))
  for key in list(spec.keys):
    spec.delete(key)
  for actuator in list(spec.actuators):
    spec.delete(actuator)
  for pair in list(spec.pairs):
    spec.delete(pair)
  for equality in list(spec.equalities):
    spec.delete(equality)
  model = spec.compile()
  return model, mujoco.MjData(model)


def in_base_frame(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
  """Returns position and rotation of the flange in the DH base frame."""
  base, flange = data.site("base_frame"), data.site("attachment_site")
  rotation = base.xmat.reshape(3, 3).T
  return (
    rotation @ (flange.xpos - base.xpos),
    rotation @ flange.xmat.reshape(3, 3),
  )


@pytest.mark.parametrize("name", POSES)
def test_arm_agrees_with_published_model(bare_arm, name: str):
  """Flange pose, mass matrix and bias force equal those of the published model."""
  model, data = bare_arm
  pose = ORACLE["poses"][name]
  data.qpos[:6], data.qvel[:] = pose["q"], 0
  mujoco.mj_forward(model, data)
  position, rotation = in_base_frame(data)
  np.testing.assert_allclose(position, pose["pos"], atol=1e-5)
  np.testing.assert_allclose(rotation, pose["mat"], atol=1e-5)
  mass = np.zeros((model.nv, model.nv))
  mujoco.mj_fullM(model, data, mass)
  np.testing.assert_allclose(mass[:6, :6], pose["M"], rtol=1e-4, atol=1e-6)
  np.testing.assert_allclose(
    data.qfrc_bias[:6], pose["qfrc_bias"], rtol=1e-4, atol=1e-4
  )


def test_jax_kinematics_agree_with_mujoco(task):
  """Tool pose and Jacobian equal those of C MuJoCo."""
  scene, rng = task.scene, np.random.default_rng(0)
  q = rng.uniform(-3, 3, (20, 6))
  position, rotation, jacobian = arm.forward(
    arm.make_chain(scene), jnp.asarray(q, jnp.float32)
  )
  data = mujoco.MjData(scene.model)
  for i in range(len(q)):
    data.qpos[scene.arm_qpos] = q[i]
    mujoco.mj_forward(scene.model, data)
    linear = np.zeros((3, scene.model.nv))
    angular = np.zeros_like(linear)
    mujoco.mj_jacSite(scene.model, data, linear, angular, scene.tool_site)
    expected = np.concatenate([linear, angular])[:, scene.arm_dof]
    np.testing.assert_allclose(position[i], data.site_xpos[scene.tool_site], atol=1e-5)
    np.testing.assert_allclose(
      rotation[i].ravel(), data.site_xmat[scene.tool_site], atol=1e-5
    )
    np.testing.assert_allclose(jacobian[i], expected, atol=1e-5)


def test_rotation_error_agrees_with_mujoco():
  """Random rotations give the rotation vectors of ``mju_quat2Vel``."""
  rng = np.random.default_rng(1)
  for _ in range(20):
    quats = rng.normal(size=(2, 4))
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    mats = np.zeros((2, 9))
    expected = np.zeros(3)
    for quat, mat in zip(quats, mats, strict=True):
      mujoco.mju_quat2Mat(mat, quat)
    # Rotation vector of target * current^-1, in the world frame.
    inverse, difference = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(inverse, quats[0])
    mujoco.mju_mulQuat(difference, quats[1], inverse)
    mujoco.mju_quat2Vel(expected, difference, 1.0)
    current, target = jnp.asarray(mats.reshape(2, 3, 3), jnp.float32)
    np.testing.assert_allclose(arm.rotation_error(current, target), expected, atol=2e-4)


def test_gripper_follows_the_closed_form(task):
  """Pad gap and height equal the manufacturer's closed form over the whole stroke."""
  model, data = task.scene.model, mujoco.MjData(task.scene.model)
  fingers = [
    model.joint(f"finger_{name}").qposadr[0] for name in ("r1", "r2", "l1", "l2")
  ]
  for angle in np.linspace(0, 1.1, 12):
    data.qpos[fingers] = angle
    mujoco.mj_forward(model, data)
    hand = data.body("gripper")
    pads = [
      hand.xmat.reshape(3, 3).T @ (data.geom(f"{side}_pad").xpos - hand.xpos)
      for side in "rl"
    ]
    thickness = 2 * model.geom("r_pad").size[1]
    gap = pads[0][1] - pads[1][1] - thickness
    np.testing.assert_allclose(
      gap, 2 * (0.0041 + 0.057 * np.cos(angle + np.pi / 6)), atol=2e-4
    )
    height = 0.078 + 0.057 * np.sin(angle + np.pi / 6)
    np.testing.assert_allclose([pad[2] for pad in pads], height, atol=2e-3)
