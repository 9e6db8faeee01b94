"""The physics protocol: one state pytree, two engines that advance it.

Both engines compute the same inverse-dynamics control at every substep (paper
Sec. V-C): a desired acceleration from the velocity error, limited, turned into
joint torques by the mass matrix and the bias force.
"""

from __future__ import annotations

from typing import Any, Protocol

from flax import struct
import jax.numpy as jnp
import numpy as np

from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

MAX_VELOCITY = 1.0  # rad/s; the paper's "m/s" can only mean joint space
MAX_ACCELERATION = 1.2  # rad/s^2 (paper Sec. V-A)
VELOCITY_GAIN = 25.0  # 1/s; reaches the desired velocity well within a 0.15 s period
GRIPPER_SPEED = 0.075  # m/s of pad gap: the closing speed in the manufacturer's manual
GRIPPER_GAIN = 10.0  # N m s/rad, half of what is stable for the fingers at 5 ms steps
GRIPPER_TORQUE = 3.5  # N m, as in the manufacturer's model: 30-60 N per pad
FINGER_LENGTH = 0.057  # m, L in gap(q) = 2 (4.1 mm + L cos(q + FINGER_ANGLE))
FINGER_ANGLE = np.pi / 6
START_TIME = 1.0  # s; C MuJoCo resets a clock to 0, so a reset world shows at once
# Fields of ``PhysicsState`` that MuJoCo's data has too.
STATE_FIELDS = ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat", "time")
# Names in ``PhysicsState.fields`` that are not fields of MuJoCo's model.
OWN_FIELDS = (
  "gripper_speed",  # f32[]: replaces GRIPPER_SPEED, m/s
  "control_delay",  # f32[]: whole physics steps until a command takes effect
  "background",  # this and the rest: see ``render.appearance.FIELDS``
  "waves",
  "odd_rgb",
  "grain",
)


class PhysicsState(struct.PyTreeNode):
  """Everything an engine needs to continue a simulation."""

  qpos: Array  # f32[*b, nq]
  qvel: Array  # f32[*b, nv]
  qacc_warmstart: Array  # f32[*b, nv]
  mocap_pos: Array  # f32[*b, nmocap, 3]
  mocap_quat: Array  # f32[*b, nmocap, 4]
  time: Array  # f32[*b], s since the reset, plus START_TIME
  fields: dict[str, Array]  # differ between worlds, see model_fields; [*b, ...]
  command: Array | None = None  # f32[*b, 7]: the last one, if commands are delayed


class Physics(Protocol):
  """An engine for a batch of worlds of one scene."""

  name: str
  scene: Scene

  def step(self, state: PhysicsState, velocity: Array, close: Array) -> PhysicsState:
    """Advances every world by one control period.

    The desired joint velocities [worlds, 6] are in rad/s; a ``close`` [worlds] of 1
    closes the gripper, 0 opens it.
    """
    ...


def initial_state(
  scene: Scene, qpos: Array, mocap_pos: Array, mocap_quat: Array, variant: Array
) -> PhysicsState:
  """Returns a state at rest, with the fields of each world's variant i32[*b]."""
  batch = qpos.shape[:-1]
  return PhysicsState(
    qpos=qpos,
    qvel=jnp.zeros((*batch, scene.model.nv)),
    qacc_warmstart=jnp.zeros((*batch, scene.model.nv)),
    mocap_pos=mocap_pos,
    mocap_quat=mocap_quat,
    time=jnp.full(batch, START_TIME, jnp.float32),
    fields={k: jnp.asarray(v)[variant] for k, v in scene.variants.items()},
  )


def model_fields(fields: dict[str, Array]) -> dict[str, Array]:
  """Returns those ``PhysicsState.fields`` that replace fields of MuJoCo's model."""
  return {name: value for name, value in fields.items() if name not in OWN_FIELDS}


def arm_torque(mass: Any, bias: Any, qvel: Any, desired: Any, limit: Any) -> Any:
  """Computes the inverse-dynamics torque [*b, 6] of the arm; NumPy or JAX arrays.

  tau = M clip(gain (v* - v), +-a_max) + bias, clipped to the joint's limit. M is the
  arm's block of the mass matrix, kg m^2; bias is the Coriolis, centrifugal and gravity
  torque. Velocities are in rad/s, torques in N m.
  """
  desired = desired.clip(-MAX_VELOCITY, MAX_VELOCITY)
  acceleration = VELOCITY_GAIN * (desired - qvel)
  acceleration = acceleration.clip(-MAX_ACCELERATION, MAX_ACCELERATION)
  return ((mass * acceleration[..., None, :]).sum(-1) + bias).clip(-limit, limit)


def gripper_torque(
  angle: Any, velocity: Any, close: Any, xp: Any, *, speed: Any = GRIPPER_SPEED
) -> Any:
  """Computes the torque of the driven finger: constant pad speed, limited squeeze.

  C MuJoCo and MJX integrate the saturated force of a MuJoCo velocity actuator
  differently, so this is an explicit servo: from the finger's angle (rad, 0 = open) and
  velocity (rad/s) to N m, positive closes. ``speed`` is that of the pad gap, m/s.
  """
  slope = 2 * FINGER_LENGTH * xp.sin(angle.clip(0.0, 1.1) + FINGER_ANGLE)
  desired = (2 * close - 1) * speed / slope
  return (GRIPPER_GAIN * (desired - velocity)).clip(-GRIPPER_TORQUE, GRIPPER_TORQUE)
