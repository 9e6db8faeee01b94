"""The physics protocol: one state pytree, two engines that advance it.

Both engines apply the torques of ``motors`` at every substep.
"""

from __future__ import annotations

from typing import Protocol

from flax import struct
import jax.numpy as jnp

from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

START_TIME = 1.0  # s; C MuJoCo resets a clock to 0, so a reset world shows at once
# Fields of ``PhysicsState`` that MuJoCo's data has too.
STATE_FIELDS = ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat", "time")
# Names in ``PhysicsState.fields`` that are not fields of MuJoCo's model.
OWN_FIELDS = (
  "gripper_speed",  # f32[]: replaces motors.GRIPPER_SPEED, m/s
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
    closes the gripper, 0 opens it; other values are clipped to [0, 1].
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
