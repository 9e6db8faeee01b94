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
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.sensor import Sensor
from apnpql_jax.robot.simulated.plant import Plant, Servo, moment
from apnpql_jax.sim.names import FLANGE_SITE

SPEED_LIMIT = math.pi  # rad/s, the UR5e's joints, data sheet
DEVIATION_LIMIT = 0.15  # rad between target and joint, beyond which the arm stops
FORCE_LIMIT = 150.0  # N on the tool: the default of the safety settings
BIAS = np.array([2.0, -1.5, 3.0, 0.1, -0.2, 0.05])  # N, N m: of the sensor when on
DRIFT = np.array([6.0, 0.0, -10.0, 0.0, 0.3, 0.0])  # N, N m: of ``World.drift``
REFERENCE_GAIN = 300.0


class World:
  """One world of a task's scene: a ``Plant`` without friction, as servoJ drives it."""

  def __init__(self, scene: str, *, noise: bool = True):
    """Compiles the scene and starts in its keyframe "neutral".

    Raises:
      ConfigError: There is no such scene.
    """
    self._plant = Plant(compile_scene(scene), Servo(friction_nm=(0.0,) * 6))
    self.model, self.data = self._plant.model, self._plant.data
    rng = np.random.default_rng(0)
    self._plant.sensor = Sensor(rng, error=0.0, noise=float(noise))
    self._plant.sensor.drift(BIAS)
    self._tool = self.model.body("gripper").id
    self._payload = 0.0, np.zeros(3)
    self._goal, self._lag = self.position, TIMESTEP
    self.lock()
    self.grip(self.finger, 0.0, 0.0)
    self.wrench = self._plant.sensor.read(self._measure())

  @property
  def position(self) -> np.ndarray:
    """Joint angles, rad."""
    return self._plant.position

  @property
  def velocity(self) -> np.ndarray:
    """Joint velocities, rad/s."""
    return self._plant.velocity

  @property
  def target_velocity(self) -> np.ndarray:
    """Velocity of the smoothed joint target, rad/s."""
    return self._velocity

  @property
  def finger(self) -> float:
    """Angle of the driven finger, rad."""
    return self._plant.gripper_angle

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
    self._plant.sensor.zero(self._measure())

  def drift(self) -> None:
    """Moves the zero of the wrench by ``DRIFT``, as warming up does, but at once."""
    self._plant.sensor.drift(DRIFT)

  def step(self) -> str:
    """Advances by 2 ms; returns why the controller would stop the arm, or ""."""
    self._smooth()
    self._plant.drive(self.target, self._velocity, self._finger_torque())
    self.wrench = self._plant.sensor.read(self._measure())
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

  def _finger_torque(self) -> float:
    wanted = _clipped(50.0 * (self._finger_goal - self.finger), self._finger_speed)
    return _clipped(25.0 * (wanted - self._plant.gripper_velocity), self._grip)

  def _measure(self) -> np.ndarray:
    """Returns the wrench of contacts and weight, without the payload's, f64[6]."""
    data, (payload, at) = self.data, self._payload
    mass, gravity = self.model.body_subtreemass[self._tool], self.model.opt.gravity
    flange = data.site(FLANGE_SITE)
    lever = mass * (data.subtree_com[self._tool] - flange.xpos)
    lever -= payload * (flange.xmat.reshape(3, 3) @ at)
    weight = (mass - payload) * gravity, moment(lever, gravity)
    return self._plant.wrench() + self._plant.in_base(*weight)


def compile_scene(scene: str) -> mujoco.MjModel:
  """Compiles the scene of a task, by its name or the path of its MJCF file."""
  path = Path(scene) if scene.endswith(".xml") else files.mjcf_path(scene)
  shared = {k: x for k, x in files.mjcf_files().items() if k != path.name}
  return mujoco.MjSpec.from_file(str(path), include=shared).compile()


def _clipped(value: float, limit: float) -> float:
  return max(-limit, min(value, limit))
