"""The plant in PyBullet: one world that is driven as a real arm is.

The virtual arm of the robot's runtime moves as in training, and Bullet's position
servos follow it, as those of the real arm do. So neither the armature that Bullet lacks
nor its velocity motors matter. Commands arrive late, and joints have Coulomb friction.
The finger with the motor moves the other three through gears.
"""

from __future__ import annotations

from collections import deque
import copy
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.virtual_arm import Admittance, VirtualArm
from apnpql_jax.sim import motors
from apnpql_jax.sim.names import FLANGE_SITE
from apnpql_jax.sim.physics import OWN_FIELDS
from apnpql_jax.sim.scene import Scene
from apnpql_jax.transfer import bullet, friction, urdf

SOLVER_ITERATIONS = 300
"""Iterations of Bullet's solver, which makes a step of 2 ms per command of the servos.

With 100, a cup creeps between the pads and slowly pushes the hand open.
"""

SERVO_GAIN = 0.1
"""Share of the position error that a servo removes in a step."""

FILTER_LAG = 0.010
"""Lag of the wrench's filter and of the cycle, s; see ``virtual_arm.Admittance``."""

FRICTION = 0.03
"""Coulomb friction of a joint as a share of its largest torque."""

FRICTION_SPEED = 0.01
"""Speed at which it is three quarters of its value, rad/s."""

GEAR_FORCE = 100.0
"""Largest torque of a gear between fingers, N m."""

FINGER_INERTIA = 0.1
"""Share of the fingers' armature that their links get.

With none, the solver is far from converged in a grip, and the gears give way.
"""

GEAR_ERP = 0.2
"""Share of a gear's error that Bullet removes in a step."""

REFRESH_CYCLES = 75
"""Cycles after which Bullet finds the contacts of the hand again: 0.15 s."""


class BulletPlant:
  """One world in PyBullet, in which ``begin`` starts an episode."""

  def __init__(self, scene: Scene, *, latency_s: float, admittance: bool):
    """Opens a simulator.

    Args:
      scene: The scene of a task.
      latency_s: Time from the virtual arm to the servos, s.
      admittance: Whether the virtual arm yields to the wrench at the tool.

    Raises:
      ConfigError: Bullet cannot simulate the scene, see ``urdf.check``.
    """
    urdf.check(scene)
    self.scene = scene
    self._client = bullet.connect()
    self._delay = round(latency_s / TIMESTEP)
    lag = latency_s + TIMESTEP / SERVO_GAIN + FILTER_LAG
    self._virtual = VirtualArm(
      ArmModel(), admittance=Admittance(lag=lag) if admittance else None
    )

  def __enter__(self) -> BulletPlant:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the simulator."""
    self._client.disconnect()

  def begin(
    self, qpos: Any, mocap_pos: Any, mocap_quat: Any, fields: dict[str, np.ndarray]
  ) -> None:
    """Builds the world of an episode.

    Args:
      qpos: Configuration f64[nq], in the units of MuJoCo.
      mocap_pos: Positions of the mocap bodies f64[nmocap, 3], m.
      mocap_quat: Their rotations f64[nmocap, 4].
      fields: The world's own ``PhysicsState.fields``.
    """
    client, scene = self._client, self.scene
    self._fields = fields
    model = with_fields(scene.model, fields)
    client.resetSimulation()
    client.setGravity(*model.opt.gravity)
    client.setPhysicsEngineParameter(
      fixedTimeStep=TIMESTEP, numSolverIterations=SOLVER_ITERATIONS
    )
    self.bodies = bodies = bullet.Bodies(client, model)
    bodies.reset(qpos, mocap_pos, mocap_quat)
    arm, finger = model.actuator_trnid[:6, 0], int(model.actuator_trnid[6, 0])
    self._arm = [bodies.joints[int(joint)] for joint in arm]
    self._limit = model.actuator_ctrlrange[:, 1]
    self._flange_body = int(model.site(FLANGE_SITE).bodyid[0])
    self._hand = {
      link
      for body, (loaded, link) in bodies.place.items()
      if loaded == bodies.robot and body > self._flange_body
    }
    self._finger = bodies.joints[finger]
    self._set_contacts(model)
    self._add_finger_inertia(model)
    others = [link for j, link in bodies.joints.items() if j > finger]
    self._add_gears(others)
    self._release_brakes([*self._arm, *others])
    angles = np.asarray(qpos, float)[scene.arm_qpos]
    self._virtual.reset(angles)
    # The command before the present one gives its speed.
    self._sent = deque([angles] * (self._delay + 2), self._delay + 2)
    self._measured = angles
    self._cycles = 0
    self._last = np.zeros(6), float(qpos[scene.gripper_qpos] > 0.5)

  def step(self, velocity: np.ndarray, close: float, period_s: float) -> None:
    """Runs a control period.

    Args:
      velocity: Desired joint velocities f64[6], rad/s.
      close: Command of the gripper, 1 to close and 0 to open.
      period_s: Length of the period, s.
    """
    late = float(self._fields.get("control_delay", 0.0)) * self.scene.model.opt.timestep
    now = (np.asarray(velocity, float), float(close))
    for command in range(round(period_s / TIMESTEP)):
      self._cycles += 1
      if self._cycles % REFRESH_CYCLES == 0:
        self._renew_contacts()
      self._drive(*(self._last if command * TIMESTEP < late else now))
      self._client.stepSimulation()
      states = self._client.getJointStates(self.bodies.robot, self._arm)
      self._measured = np.array([state[0] for state in states])
    self._last = now

  def wrench(self) -> np.ndarray:
    """Returns the contact wrench on the hand f64[6], N and N m.

    See ``protocols.ArmState`` for its frame.
    """
    pos, mat = self.bodies.pose(self._flange_body)
    flange = pos + mat @ self.bodies.model.site(FLANGE_SITE).pos
    force, torque = np.zeros(3), np.zeros(3)
    # Of all pairs: asked for one body, PyBullet does not turn the friction with a pair.
    for contact in self._client.getContactPoints():
      sides = (contact[1], contact[3]), (contact[2], contact[4])
      for (body, link), sign in zip(sides, (1, -1), strict=True):
        if body == self.bodies.robot and link in self._hand:
          push = contact[9] * np.array(contact[7])
          push += sum(contact[k] * np.array(contact[k + 1]) for k in (10, 12))
          force += sign * push
          torque += np.cross(np.array(contact[5]) - flange, sign * push)
    base = self._virtual.model.base_mat
    return np.concatenate([base.T @ force, base.T @ torque])

  def _drive(self, velocity: np.ndarray, close: float) -> None:
    """Sends the commands of one cycle of 2 ms."""
    client, robot = self._client, self.bodies.robot
    wrench = self.wrench() if self._virtual.admittance else None
    self._sent.append(self._virtual.step(velocity, self._measured, wrench))
    before, angles = self._sent[0], self._sent[1]
    *joints, finger = client.getJointStates(robot, [*self._arm, self._finger])
    client.setJointMotorControlArray(
      robot,
      self._arm,
      client.POSITION_CONTROL,
      targetPositions=angles.tolist(),
      targetVelocities=((angles - before) / TIMESTEP).tolist(),
      positionGains=[SERVO_GAIN] * 6,
      velocityGains=[1.0] * 6,
      forces=self._limit[:6].tolist(),
    )
    moving = np.tanh(np.array([joint[1] for joint in joints]) / FRICTION_SPEED)
    client.setJointMotorControlArray(
      robot,
      self._arm,
      client.TORQUE_CONTROL,
      forces=(-FRICTION * self._limit[:6] * moving).tolist(),
    )
    client.setJointMotorControl2(
      robot,
      self._finger,
      client.VELOCITY_CONTROL,
      targetVelocity=self._finger_rate(finger[0], close),
      force=self._limit[6],
    )

  def _renew_contacts(self) -> None:
    """Lets Bullet find the contacts of the hand again.

    It keeps the normals of contacts that last in the axes of the world. When the hand
    turns an object over, old ones would push the wrong way, and fingers not let go.
    """
    for link in self._hand:
      self._client.setCollisionFilterGroupMask(self.bodies.robot, link, 1, -1)

  def _finger_rate(self, angle: float, close: float) -> float:
    """Returns the speed of the driven finger at an angle in rad, rad/s."""
    speed = float(self._fields.get("gripper_speed", motors.GRIPPER_SPEED))
    return float(motors.finger_rate(np.float64(angle), close, np, speed=speed))

  def _set_contacts(self, model: mujoco.MjModel) -> None:
    """Sets what decides on contacts, and the damping of joints."""
    sliding, spinning = friction.sliding(model), friction.spinning(model)
    for body, (loaded, link) in self.bodies.place.items():
      dof = model.body_dofadr[body]
      hinge = link >= 0 and dof >= 0
      self._client.changeDynamics(
        loaded,
        link,
        lateralFriction=sliding.get(body, 1.0),
        spinningFriction=spinning.get(body, 0.0),
        rollingFriction=0.0,
        restitution=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
        jointDamping=float(model.dof_damping[dof]) if hinge else 0.0,
      )

  def _add_finger_inertia(self, model: mujoco.MjModel) -> None:
    """Adds a share of the fingers' armature, which Bullet lacks, to their links."""
    for joint, link in self.bodies.joints.items():
      body = int(model.jnt_bodyid[joint])
      if link not in self._hand:
        continue
      mat = np.zeros(9)
      mujoco.mju_quat2Mat(mat, model.body_iquat[body])
      # The principal axis that the joint turns about.
      axis = np.abs(mat.reshape(3, 3).T @ model.jnt_axis[joint]).round()
      extra = FINGER_INERTIA * model.dof_armature[model.jnt_dofadr[joint]] * axis
      self._client.changeDynamics(
        self.bodies.robot,
        link,
        localInertiaDiagonal=(model.body_inertia[body] + extra).tolist(),
      )

  def _add_gears(self, others: list[int]) -> None:
    """Lets the driven finger move the others."""
    for link in others:
      gear = self._client.createConstraint(
        self.bodies.robot,
        self._finger,
        self.bodies.robot,
        link,
        self._client.JOINT_GEAR,
        [1, 0, 0],
        [0, 0, 0],
        [0, 0, 0],
      )
      self._client.changeConstraint(
        gear, gearRatio=-1, maxForce=GEAR_FORCE, erp=GEAR_ERP
      )

  def _release_brakes(self, links: list[int]) -> None:
    """Removes the brakes that PyBullet puts into every joint."""
    for link in links:
      self._client.setJointMotorControl2(
        self.bodies.robot, link, self._client.VELOCITY_CONTROL, force=0
      )


def with_fields(model: mujoco.MjModel, fields: dict[str, np.ndarray]) -> mujoco.MjModel:
  """Returns a copy of the model with the fields of one world."""
  model = copy.copy(model)
  for name, value in fields.items():
    if name not in OWN_FIELDS:
      getattr(model, name)[...] = value
  return model
