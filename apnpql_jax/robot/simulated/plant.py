"""A simulated robot at its table, in C MuJoCo: the whole scene of a task.

The arm is position-controlled as with the controller's ``servoJ``: it follows a target
with a lag, by stiff feedback with gravity compensation, against the friction of its
joints. The wrist sensor reports the contacts of hand and fingers, see ``sensor``.
"""

from __future__ import annotations

from collections import deque
import dataclasses

import mujoco
import numpy as np

from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import ArmState
from apnpql_jax.robot.sensor import Sensor
from apnpql_jax.sim import motors
from apnpql_jax.sim.names import ARM_JOINTS, BASE_SITE, FLANGE_SITE, GRIPPER_JOINT


@dataclasses.dataclass(frozen=True)
class Servo:
  """Servo parameters of the simulated arm: guesses, not those of a real UR5e."""

  lookahead_s: float = 0.03
  """Time constant with which the target is approached, s."""

  gain: float = 100.0
  """Natural frequency of the position feedback, 1/s; critically damped."""

  friction_nm: tuple[float, ...] = (5.0, 5.0, 5.0, 1.5, 1.5, 1.5)
  """Coulomb friction of the joints, N m."""

  latency_s: float = 0.0
  """Time until a command arrives, s."""


class Plant:
  """The robot and its scene, advanced by 2 ms at a time."""

  def __init__(
    self, model: mujoco.MjModel, servo: Servo | None = None, *, seed: int = 0
  ) -> None:
    """Starts at the keyframe "neutral"; changes the timestep and friction of model."""
    self.servo = Servo() if servo is None else servo
    self.model, self.data = model, mujoco.MjData(model)
    model.opt.timestep = TIMESTEP
    joints = [model.joint(name) for name in ARM_JOINTS]
    self._qpos = np.array([int(x.qposadr[0]) for x in joints])
    self._dof = np.array([int(x.dofadr[0]) for x in joints])
    model.dof_frictionloss[self._dof] = self.servo.friction_nm
    finger = model.joint(GRIPPER_JOINT)
    self._finger, self._finger_dof = int(finger.qposadr[0]), int(finger.dofadr[0])
    self._limit = model.actuator_ctrlrange[: len(ARM_JOINTS), 1].copy()
    self._mass = np.zeros((model.nv, model.nv))
    self._block = np.ix_(self._dof, self._dof)
    self._gripper = model.body("gripper").id
    self._hand = subtree(model, self._gripper)
    self.sensor = Sensor(np.random.default_rng(seed))
    """The force-torque sensor."""
    mujoco.mj_resetDataKeyframe(model, self.data, model.key("neutral").id)
    self._settle()

  def zero_force(self) -> None:
    """Zeroes the sensor, which then reads the present wrench as none."""
    self.sensor.zero(self.wrench())

  def place(
    self, qpos: np.ndarray, mocap_pos: np.ndarray, mocap_quat: np.ndarray
  ) -> None:
    """Puts the objects where a reset state has them; the robot stays as it is."""
    robot = slice(0, self._finger + 4)
    placed = np.array(qpos, float)
    placed[robot] = self.data.qpos[robot]
    self.data.qpos[:], self.data.qvel[:] = placed, 0.0
    self.data.mocap_pos[:], self.data.mocap_quat[:] = mocap_pos, mocap_quat
    mujoco.mj_forward(self.model, self.data)

  def put_arm(self, position: np.ndarray) -> None:
    """Puts the arm at joint angles f64[6], at rest."""
    self.data.qpos[self._qpos], self.data.qvel[self._dof] = position, 0.0
    self._settle()

  def step(self, target: np.ndarray | None, close: bool | None) -> None:
    """Advances by 2 ms.

    Args:
      target: Joint angles to follow f64[6]; without, the arm keeps its place.
      close: Whether the gripper closes or opens; without, the fingers keep theirs.
    """
    data, before = self.data, self._reference
    self._queue.append(self._queue[-1] if target is None else np.array(target))
    share = 1 - np.exp(-TIMESTEP / self.servo.lookahead_s)
    self._reference = before + share * (self._queue[0] - before)
    finger = motors.gripper_torque(
      data.qpos[self._finger],
      data.qvel[self._finger_dof],
      float(bool(close)),
      np,
      speed=0.0 if close is None else motors.GRIPPER_SPEED,
    )
    self.drive(self._reference, (self._reference - before) / TIMESTEP, finger)

  def drive(self, target: np.ndarray, velocity: np.ndarray, finger: float) -> None:
    """Advances by 2 ms, with the stiff feedback alone.

    Args:
      target: Joint angles f64[6] of this instant.
      velocity: Joint velocities f64[6] of this instant, rad/s.
      finger: Torque of the driven finger, N m.
    """
    model, data, gain = self.model, self.data, self.servo.gain
    mujoco.mj_fullM(model, data, self._mass)
    wanted = gain**2 * (target - self.position) + 2 * gain * (velocity - self.velocity)
    torque = self._mass[self._block] @ wanted + data.qfrc_bias[self._dof]
    data.ctrl[: len(ARM_JOINTS)] = torque.clip(-self._limit, self._limit)
    data.ctrl[len(ARM_JOINTS)] = finger
    mujoco.mj_step(model, data)

  def arm_state(self, now: float) -> ArmState:
    """Returns what the arm measures."""
    reading = self.sensor.read(self.wrench())
    return ArmState(now, self.position, self.velocity, reading)

  def wrench(self) -> np.ndarray:
    """Returns force and torque of the contacts on the hand, see ``ArmState.wrench``."""
    model, data = self.model, self.data
    mujoco.mj_rnePostConstraint(model, data)
    torque, force = data.cfrc_ext[self._hand].sum(0).reshape(2, 3)
    center = data.subtree_com[model.body_rootid[self._gripper]]
    lever = center - data.site(FLANGE_SITE).xpos
    return self.in_base(force, torque + moment(lever, force))

  def in_base(self, force: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Turns force and torque from world axes, f64[3] each, into those of the base."""
    turn = self.data.site(BASE_SITE).xmat.reshape(3, 3).T
    return np.concatenate([turn @ force, turn @ torque])

  @property
  def position(self) -> np.ndarray:
    """Joint angles f64[6], rad."""
    return self.data.qpos[self._qpos]

  @property
  def velocity(self) -> np.ndarray:
    """Joint velocities f64[6], rad/s."""
    return self.data.qvel[self._dof]

  @property
  def gripper_angle(self) -> float:
    """Angle of the driven finger, rad."""
    return float(self.data.qpos[self._finger])

  @property
  def gripper_velocity(self) -> float:
    """Velocity of the driven finger, rad/s."""
    return float(self.data.qvel[self._finger_dof])

  def _settle(self) -> None:
    """Forgets commands and lets the arm hold where it is."""
    self._reference = self.data.qpos[self._qpos].copy()
    count = 1 + round(self.servo.latency_s / TIMESTEP)
    self._queue = deque([self._reference.copy()] * count, maxlen=count)
    mujoco.mj_forward(self.model, self.data)


def moment(lever: np.ndarray, force: np.ndarray) -> np.ndarray:
  """Returns the cross product f64[3], twenty times as fast as ``np.cross``."""
  found = np.zeros(3)
  mujoco.mju_cross(found, lever, force)
  return found


def subtree(model: mujoco.MjModel, root: int) -> np.ndarray:
  """Returns bool[bodies]: whether a body is ``root`` or its descendant."""
  inside = np.zeros(model.nbody, bool)
  for body in range(root, model.nbody):
    inside[body] = body == root or inside[model.body_parentid[body]]
  return inside
