"""PyBullet as a plant: one world that is driven as a real arm is.

A virtual arm integrates the motor model of training. Its joint positions are the
commands of Bullet's position servos, as servoJ's are on the real arm, so that neither
the armature that Bullet lacks nor its velocity motors matter. Commands arrive late, and
joints have Coulomb friction. The finger that the motor drives moves the other three
through gears.
"""

from __future__ import annotations

from collections import deque
import copy
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.sim import motors
from apnpql_jax.sim.physics import OWN_FIELDS
from apnpql_jax.sim.scene import Scene
from apnpql_jax.transfer import bullet, contacts
from apnpql_jax.types import Array

COMMAND_S = 0.002
"""Time between commands of the servos, as of servoJ, s."""

SUBSTEPS = 2
"""Steps of Bullet per command."""

ITERATIONS = 100
"""Iterations of Bullet's solver."""

SERVO_GAIN = 0.1
"""Share of the position error that a servo removes in a step of Bullet."""

FRICTION = 0.03
"""Coulomb friction of a joint as a share of its largest torque."""

FRICTION_SPEED = 0.01
"""Speed at which it is three quarters of its value, rad/s."""

GEAR_FORCE = 100.0
"""Largest torque of a gear between fingers, N m."""


class Plant:
  """One world; ``begin`` starts an episode."""

  def __init__(self, scene: Scene, *, latency_s: float, admittance: bool):
    """Opens a simulator.

    Raises:
      ConfigError: PyBullet is not installed.
    """
    self.scene = scene
    self._client = bullet.connect("--physics bullet")
    self._delay = round(latency_s / COMMAND_S)
    self._admittance = admittance

  def close(self) -> None:
    """Frees the simulator."""
    self._client.disconnect()

  def begin(
    self, qpos: Any, mocap_pos: Any, mocap_quat: Any, fields: dict[str, np.ndarray]
  ) -> None:
    """Builds the world of an episode, with its own ``PhysicsState.fields``."""
    client, scene = self._client, self.scene
    self._fields = fields
    model = with_fields(scene.model, fields)
    client.resetSimulation()
    client.setGravity(*model.opt.gravity)
    client.setPhysicsEngineParameter(
      fixedTimeStep=COMMAND_S, numSubSteps=SUBSTEPS, numSolverIterations=ITERATIONS
    )
    self.bodies = bodies = bullet.Bodies(client, model)
    bodies.reset(qpos, mocap_pos, mocap_quat)
    arm, finger = model.actuator_trnid[:6, 0], int(model.actuator_trnid[6, 0])
    self._arm = [bodies.joints[int(joint)] for joint in arm]
    self._limit = model.actuator_ctrlrange[:, 1]
    self._finger = bodies.joints[finger]
    self._touch(model)
    others = [link for j, link in bodies.joints.items() if j > finger]
    self._couple(others)
    self._still([*self._arm, *others])
    angles = np.asarray(qpos, float)[scene.arm_qpos]
    self._virtual = VirtualArm(angles)
    self._sent = deque([(angles, np.zeros(6))] * (self._delay + 1), self._delay + 1)
    self._last = None

  def step(self, velocity: np.ndarray, close: float, period_s: float) -> None:
    """Runs a control period with desired joint velocities f64[6], rad/s."""
    late = float(self._fields.get("control_delay", 0.0)) * self.scene.model.opt.timestep
    now = (np.asarray(velocity, float), float(close))
    for command in range(round(period_s / COMMAND_S)):
      early = self._last is not None and command * COMMAND_S < late
      self._drive(*(self._last if early else now))
      self._client.stepSimulation()
    self._last = now

  def _drive(self, velocity: np.ndarray, close: float) -> None:
    """Sends the commands of ``COMMAND_S``."""
    client, robot = self._client, self.bodies.robot
    self._sent.append(self._virtual.step(velocity, COMMAND_S))
    angles, rates = self._sent[0]
    client.setJointMotorControlArray(
      robot,
      self._arm,
      client.POSITION_CONTROL,
      targetPositions=angles.tolist(),
      targetVelocities=rates.tolist(),
      positionGains=[SERVO_GAIN] * 6,
      velocityGains=[1.0] * 6,
      forces=self._limit[:6].tolist(),
    )
    *joints, finger = client.getJointStates(robot, [*self._arm, self._finger])
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

  def _finger_rate(self, angle: float, close: float) -> float:
    speed = float(self._fields.get("gripper_speed", motors.GRIPPER_SPEED))
    return float(motors.finger_rate(np.float64(angle), close, np, speed=speed))

  def _touch(self, model: mujoco.MjModel) -> None:
    """Sets what decides on contacts, and the damping of joints."""
    sliding, spinning = contacts.sliding(model), contacts.spinning(model)
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

  def _couple(self, others: list[int]) -> None:
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
      self._client.changeConstraint(gear, gearRatio=-1, maxForce=GEAR_FORCE, erp=0.2)

  def _still(self, links: list[int]) -> None:
    """Takes out the brakes that PyBullet puts into every joint."""
    for link in links:
      self._client.setJointMotorControl2(
        self.bodies.robot, link, self._client.VELOCITY_CONTROL, force=0
      )


class Worlds:
  """A plant per world, for the loop of ``play``."""

  def __init__(self, env: Env, *, latency_s: float, admittance: bool):
    """Keeps the settings; plants are built when episodes begin."""
    self._env, self._plants = env, []
    self._options = {"latency_s": latency_s, "admittance": admittance}

  def __enter__(self) -> Worlds:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the simulators."""
    for plant in self._plants:
      plant.close()

  def advance(self, state: EnvState, action: Array, running: np.ndarray) -> Arrival:
    """Runs a control period of the running worlds; the others stand still.

    It takes the place of ``Env.advance``, without resets. Plants carry the state of
    servos and solver, so that they follow the worlds from their first instant on.
    """
    physics: Any = jax.tree.map(np.array, state.physics)
    action, elapsed = np.asarray(action), np.asarray(state.elapsed)
    while len(self._plants) < len(running):
      self._plants.append(Plant(self._env.task.scene, **self._options))
    for world in np.flatnonzero(running):
      plant = self._plants[world]
      if not elapsed[world]:
        fields = {name: x[world] for name, x in physics.fields.items()}
        poses = (x[world] for x in (physics.mocap_pos, physics.mocap_quat))
        plant.begin(physics.qpos[world], *poses, fields)
      period = self._env.config.control_period_s
      plant.step(action[world, :6], action[world, 6], period)
      physics.qpos[world], physics.qvel[world] = plant.bodies.state()
      physics.time[world] += period
    broken = ~np.isfinite(np.concatenate([physics.qpos, physics.qvel], 1)).all(1)
    moved = jax.tree.map(jnp.asarray, physics)
    arrival = Arrival.after(state, moved, state.targets, jnp.zeros(len(running), bool))
    return arrival.replace(faults=state.faults + broken)


class VirtualArm:
  """Stand-in."""

  def __init__(self, angles: np.ndarray):
    self.angles, self.rates = angles.copy(), np.zeros(6)

  def step(self, velocity: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    desired = velocity.clip(-motors.MAX_VELOCITY, motors.MAX_VELOCITY)
    acceleration = (motors.VELOCITY_GAIN * (desired - self.rates)).clip(
      -motors.MAX_ACCELERATION, motors.MAX_ACCELERATION
    )
    self.rates = self.rates + dt * acceleration
    self.angles = self.angles + dt * self.rates
    return self.angles.copy(), self.rates.copy()


def with_fields(model: mujoco.MjModel, fields: dict[str, np.ndarray]) -> mujoco.MjModel:
  """Returns a copy of the model with the fields of one world."""
  model = copy.copy(model)
  for name, value in fields.items():
    if name not in OWN_FIELDS:
      getattr(model, name)[...] = value
  return model
