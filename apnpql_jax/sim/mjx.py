"""MJX engine: the reference on GPU and TPU."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax.sim import motors, physics
from apnpql_jax.sim.mjx_patches import patch_mjx
from apnpql_jax.sim.physics import STATE_FIELDS, PhysicsState
from apnpql_jax.sim.quiet_mjx import mjx
from apnpql_jax.sim.scene import Scene, free_joints
from apnpql_jax.types import Array


class MjxPhysics:
  """Worlds advanced by ``jax.vmap`` over MJX; see ``physics.Physics``."""

  name = "mjx"

  def __init__(self, scene: Scene, *, substeps: int):
    """Prepares the model, for ``substeps`` physics steps per control period."""
    patch_mjx()
    self.scene = scene
    self._substeps = substeps
    self._free = np.isin(scene.model.dof_jntid, free_joints(scene.model))
    device = jax.local_devices()[0]  # MJX's default is the first of all processes.
    line_search = int(scene.model.numeric("mjx_ls_iterations").data[0])
    self._model = mjx.put_model(scene.model, device, impl="jax").tree_replace(
      {"opt.ls_iterations": line_search}
    )
    self._template = mjx.make_data(scene.model, device, impl="jax")
    self._torque_limit = jnp.asarray(scene.model.actuator_ctrlrange[:6, 1], jnp.float32)

  def step(self, state: PhysicsState, velocity: Array, close: Array) -> PhysicsState:
    """See ``physics.Physics.step``."""
    return jax.vmap(self._step_world)(state, velocity, close)

  def _step_world(self, state, velocity, close):
    model = self._model.replace(**physics.model_fields(state.fields))
    speed = state.fields.get("gripper_speed", motors.GRIPPER_SPEED)
    data = self._template.replace(**{k: getattr(state, k) for k in STATE_FIELDS})

    def substep(carry, index):
      now, grip = velocity, close
      if index is not None:
        late = index < state.fields["control_delay"]
        now = jnp.where(late, state.command[:6], velocity)
        grip = jnp.where(late, state.command[6], close)
      return self._substep(model, carry, now, grip, speed), None

    indices, command = None, None
    if state.command is not None:
      indices, command = jnp.arange(self._substeps), jnp.append(velocity, close)
    data, _ = jax.lax.scan(substep, data, indices, length=self._substeps)
    return state.replace(
      command=command,
      qpos=data.qpos,
      qvel=data.qvel,
      qacc_warmstart=data.qacc_warmstart,
      time=data.time,
    )

  def _substep(self, model, data, velocity, close, speed):
    # mjx.step with the control after its velocity stage, whose mass and bias it uses.
    arm = self.scene.arm_dof
    data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
    mass, limit = mjx.full_m(model, data)[arm][:, arm], self._torque_limit
    bias, qvel = data.qfrc_bias[arm], data.qvel[arm]
    torque = motors.arm_torque(mass, bias, qvel, velocity, limit)
    angle, rate = data.qpos[self.scene.gripper_qpos], data.qvel[self.scene.gripper_dof]
    finger = motors.gripper_torque(angle, rate, close, jnp, speed=speed)
    data = data.replace(ctrl=jnp.append(torque, finger))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    data = mjx.solve(model, data)
    # In float32 the solver can stop before forces match accelerations. The residual
    # would throw light objects away: free bodies get the accelerations' forces.
    force = mjx.mul_m(model, data, data.qacc) - data.qfrc_smooth
    force = jnp.where(self._free, force, data.qfrc_constraint)
    return mjx.implicit(model, data.replace(qfrc_constraint=force))


def contact_slots(model: mujoco.MjModel) -> tuple[int, int]:
  """Returns the contact slots and constraint rows that MJX fills in every substep."""
  slots = mjx.make_data(model, impl="jax")._impl
  return slots.ncon, int(slots.nefc)
