"""The arm alone, as in training: kinematics and dynamics from ``mjcf/robot.xml``.

The gripper is rigid and open. The world has its origin at the robot's base, z up, and
the workspace along +x, as in the contract.
"""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from apnpql_jax.config import files
from apnpql_jax.sim.names import ARM_JOINTS, BASE_SITE, FLANGE_SITE, TOOL_SITE


@dataclasses.dataclass(frozen=True)
class Dynamics:
  """The arm's equations of motion at a state; Jacobians are linear, then angular."""

  mass: np.ndarray  # f64[6, 6], kg m^2
  bias: np.ndarray  # f64[6]: Coriolis, centrifugal and gravity torque, N m
  flange: np.ndarray  # f64[6, 6]: Jacobian of the flange in the world
  tool: np.ndarray  # f64[6, 6]: Jacobian of the tool in the world


class ArmModel:
  """Kinematics and dynamics of the UR5e with its gripper; not safe for threads."""

  def __init__(self) -> None:
    spec = mujoco.MjSpec.from_string(files.mjcf_files()["robot.xml"].decode())
    for item in (*spec.equalities, *spec.actuators[len(ARM_JOINTS) :]):
      spec.delete(item)
    for joint in spec.joints[len(ARM_JOINTS) :]:
      spec.delete(joint)
    self.model = spec.compile()
    self.torque_limit = self.model.actuator_ctrlrange[:, 1].copy()
    self.joint_range = self.model.jnt_range.copy()  # f64[6, 2], rad
    self._data = mujoco.MjData(self.model)
    self._tool, self._flange, base = (
      self.model.site(name).id for name in (TOOL_SITE, FLANGE_SITE, BASE_SITE)
    )
    mujoco.mj_kinematics(self.model, self._data)
    self.base_mat = self._data.site_xmat[base].reshape(3, 3).copy()

  def tool_position(self, position: np.ndarray) -> np.ndarray:
    """Returns the position of the tool in the world, f64[3], m."""
    self._data.qpos[:] = position
    mujoco.mj_kinematics(self.model, self._data)
    return self._data.site_xpos[self._tool].copy()

  def flange_pose(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns position f64[3] (m) and rotation f64[3, 3] of the flange in the world."""
    self._data.qpos[:] = position
    mujoco.mj_kinematics(self.model, self._data)
    site = self._data.site(self._flange)
    return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

  def dynamics(self, position: np.ndarray, velocity: np.ndarray) -> Dynamics:
    """Returns the equations of motion at joint angles and velocities f64[6]."""
    model, data = self.model, self._data
    data.qpos[:], data.qvel[:] = position, velocity
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    jacobians = []
    for site in (self._flange, self._tool):
      jacobian = np.zeros((6, model.nv))
      mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
      jacobians.append(jacobian)
    return Dynamics(mass, data.qfrc_bias.copy(), *jacobians)
