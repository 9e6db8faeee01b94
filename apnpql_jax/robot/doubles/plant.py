"""Arm, gripper and objects of a task, as the controllers of the doubles move them.

C MuJoCo in steps of 2 ms. The arm follows the joint targets of servoJ like a stiff
position servo. How a UR5e smooths its targets is not published; the model is a lag of
first order whose time constant is the look-ahead time at gain 300, and grows when the
gain falls, within limits of speed. The plant therefore shows that a program runs and
stops as it should, not how far a real arm lags.
"""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np

from apnpql_jax.config import files
from apnpql_jax.robot.arm_model import BASE, FLANGE, JOINTS
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.simulated.plant import subtree

FINGER = "finger_r1"
SPEED_LIMIT = math.pi  # rad/s, the UR5e's joints, data sheet
STIFFNESS, DAMPING = 1e4, 200.0  # 1/s^2, 1/s: critically damped at 16 Hz
DEVIATION_LIMIT = 0.15  # rad between target and joint, beyond which the arm stops
FORCE_LIMIT = 150.0  # N on the tool: the default of the safety settings
BIAS = np.array([2.0, -1.5, 3.0, 0.1, -0.2, 0.05])  # N, N m: of the sensor when on
DRIFT = np.array([6.0, 0.0, -10.0, 0.0, 0.3, 0.0])  # N, N m: of ``World.drift``
NOISE = np.array([0.3, 0.3, 0.3, 0.01, 0.01, 0.01])  # N, N m: standard deviations
REFERENCE_GAIN = 300.0


class World:
  """One world of a task's scene."""

  def __init__(self, scene: str, *, noise: bool = True):
    """Compiles the scene and starts in its keyframe "neutral".

    Raises:
      ConfigError: There is no such scene.
    """
    self.model = model = compile_scene(scene)
    model.opt.timestep = TIMESTEP
    self.data = data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("neutral").id)
    joints = [model.joint(name) for name in JOINTS]
    self._qpos = np.array([joint.qposadr[0] for joint in joints])
    self._dofs = np.array([joint.dofadr[0] for joint in joints])
    self._torques = model.actuator_ctrlrange[:6, 1].copy()
    finger = model.joint(FINGER)
    self._finger, self._finger_dof = int(finger.qposadr[0]), int(finger.dofadr[0])
    self._gripper = model.body("gripper").id
    self._tool = subtree(model, self._gripper)
    self._weight = model.body_subtreemass[self._gripper] * model.opt.gravity
    self._flange, self._base = data.site(FLANGE), data.site(BASE)
    self._mass = np.zeros((model.nv, model.nv))
    self._block = np.ix_(self._dofs, self._dofs)
    self._goal, self._lag = self.position, TIMESTEP
    self.lock()
    self._finger_goal, self._finger_speed, self._grip = self.finger, 0.0, 0.0
    self._rng = np.random.default_rng(0) if noise else None
    self._bias, self._zero = BIAS, np.zeros(6)
    self._payload = 0.0, np.zeros(3)
    mujoco.mj_forward(model, data)
    self.wrench = self._measure()

  @property
  def position(self) -> np.ndarray:
    """Joint angles, rad."""
    return self.data.qpos[self._qpos]

  @property
  def velocity(self) -> np.ndarray:
    """Joint velocities, rad/s."""
    return self.data.qvel[self._dofs]

  @property
  def target_velocity(self) -> np.ndarray:
    """Velocity of the smoothed joint target, rad/s."""
    return self._velocity

  @property
  def finger(self) -> float:
    """Angle of the driven finger, rad."""
    return float(self.data.qpos[self._finger])

  @property
  def finger_velocity(self) -> float:
    """Velocity of the driven finger, rad/s."""
    return float(self.data.qvel[self._finger_dof])

  def servo(self, goal: np.ndarray, lookahead: float, gain: float) -> None:
    """Takes a target of servoJ, rad; ``lookahead`` in s."""
    self._goal, self._braking = np.asarray(goal, float), 0.0
    self._lag = lookahead * REFERENCE_GAIN / max(gain, 1.0)

  def brake(self, deceleration: float = 10.0) -> None:
    """Comes to rest with this deceleration of the fastest joint, rad/s^2."""
    self._braking = max(deceleration, 0.1)

  def lock(self) -> None:
    """Closes the brakes where the arm is; ``servo`` opens them."""
    self.target, self._velocity = self.position, np.zeros(6)
    self._braking = np.inf

  @property
  def at_rest(self) -> bool:
    """Whether the joint target stands still."""
    return not self._velocity.any()

  def grip(self, angle: float, speed: float, torque: float) -> None:
    """Moves the fingers to ``angle`` (rad) at ``speed`` (rad/s) with N m at most."""
    self._finger_goal, self._finger_speed, self._grip = angle, speed, torque

  def set_payload(self, mass: float, center: np.ndarray) -> None:
    """Sets what the controller takes off the wrench: kg, m from the flange."""
    self._payload = mass, np.asarray(center, float)

  def zero_wrench(self) -> None:
    """Makes the present wrench the origin of its measurement."""
    self._zero = self._measure() + self._zero

  def drift(self) -> None:
    """Moves the zero of the wrench by ``DRIFT``, as warming up does, but at once."""
    self._bias = self._bias + DRIFT

  def step(self) -> str:
    """Advances by 2 ms; returns why the controller would stop the arm, or ""."""
    self._smooth()
    model, data = self.model, self.data
    mujoco.mj_step1(model, data)
    data.ctrl[:6] = self._arm_torque()
    data.ctrl[6] = self._finger_torque()
    mujoco.mj_step2(model, data)
    self.wrench = self._measure()
    if np.abs(self.target - self.position).max() > DEVIATION_LIMIT:
      return "the joints deviate from their target"
    if np.linalg.norm(self.wrench[:3]) > FORCE_LIMIT:
      return f"the force on the tool exceeds {FORCE_LIMIT:g} N"
    return ""

  def _smooth(self) -> None:
    """Moves the joint target of this cycle."""
    if self._braking:
      speed, drop = np.abs(self._velocity).max(), self._braking * TIMESTEP
      left = 0.0 if speed <= drop else 1 - drop / speed
      self._velocity = self._velocity * left
    else:
      lag = max(self._lag, TIMESTEP)
      wanted = (self._goal - self.target) / lag
      self._velocity = wanted.clip(-SPEED_LIMIT, SPEED_LIMIT)
    self.target = self.target + self._velocity * TIMESTEP

  def _arm_torque(self) -> np.ndarray:
    """Computes the torque of a stiff servo with the arm's own dynamics, N m."""
    mujoco.mj_fullM(self.model, self.data, self._mass)
    mass = self._mass[self._block]
    errors = self.target - self.position, self._velocity - self.velocity
    torque = mass @ (STIFFNESS * errors[0] + DAMPING * errors[1])
    torque += self.data.qfrc_bias[self._dofs]
    return torque.clip(-self._torques, self._torques)

  def _finger_torque(self) -> float:
    wanted = _clipped(50.0 * (self._finger_goal - self.finger), self._finger_speed)
    return _clipped(25.0 * (wanted - self.finger_velocity), self._grip)

  def _measure(self) -> np.ndarray:
    """Returns the reading of the force-torque sensor, N and N m in base axes."""
    wrench = self._contact()
    arm = self.data.subtree_com[self._gripper] - self._flange.xpos
    wrench += _moment(self._weight, arm)
    mass, at = self._payload
    frame = self._flange.xmat.reshape(3, 3)
    wrench -= _moment(mass * self.model.opt.gravity, frame @ at)
    base = self._base.xmat.reshape(3, 3)
    turned = np.concatenate([wrench[:3] @ base, wrench[3:] @ base])
    turned += self._bias - self._zero
    return turned + NOISE * self._rng.normal(size=6) if self._rng else turned

  def _contact(self) -> np.ndarray:
    """Returns force and torque on the tool about the flange, in world axes."""
    total, force = np.zeros(6), np.zeros(6)
    contacts = self.data.contact
    on_tool = self._tool[self.model.geom_bodyid[contacts.geom]]
    for index in np.flatnonzero(on_tool[:, 0] != on_tool[:, 1]):
      mujoco.mj_contactForce(self.model, self.data, index, force)
      axes = contacts.frame[index].reshape(3, 3)
      sign = 1.0 if on_tool[index, 1] else -1.0  # The force acts on the second geom.
      there = sign * force[:3] @ axes
      total += _moment(there, contacts.pos[index] - self._flange.xpos)
      total[3:] += sign * force[3:] @ axes
    return total


def compile_scene(scene: str) -> mujoco.MjModel:
  """Compiles the scene of a task, by its name or the path of its MJCF file."""
  path = Path(scene) if scene.endswith(".xml") else files.mjcf_path(scene)
  shared = {k: x for k, x in files.mjcf_files().items() if k != path.name}
  return mujoco.MjSpec.from_file(str(path), include=shared).compile()


def _clipped(value: float, limit: float) -> float:
  return max(-limit, min(value, limit))


def _moment(force: np.ndarray, arm: np.ndarray) -> np.ndarray:
  (x, y, z), (a, b, c) = arm, force
  return np.array([a, b, c, y * c - z * b, z * a - x * c, x * b - y * a])
