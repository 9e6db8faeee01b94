"""C MuJoCo engine: a batch of worlds on threads, called from inside jit.

On a machine without an accelerator it is ten to a hundred times faster than MJX on
contact-rich scenes. Compiled code calls it by name, see ``host_call``.
"""

from __future__ import annotations

import functools
import hashlib
import threading

import jax
import jax.numpy as jnp
import mujoco
from mujoco import batch as mujoco_batch
import numpy as np

from apnpql_jax.sim import host_call, motors, physics
from apnpql_jax.sim.physics import STATE_FIELDS, PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

_CONTROL = ("gripper_speed", "control_delay", "command")
_VISUAL = ("cam_", "light_", "geom_rgba")  # prefixes of fields without physics


class NativePhysics:
  """Worlds advanced by ``mujoco.batch``; see ``physics.Physics``.

  Every call loads the whole state into the batch, so a step is a pure function.
  """

  name = "native"

  def __init__(self, scene: Scene, *, substeps: int):
    """Prepares the engine, for ``substeps`` physics steps per control period."""
    self.scene = scene
    self._substeps = substeps
    self._torque_limit = scene.model.actuator_ctrlrange[:6, 1].copy()
    self._mass_index = _mass_index(scene.model, scene.arm_dof)
    self._batch = functools.lru_cache(maxsize=4)(self._new_batch)
    self._lock = threading.Lock()

  def step(self, state: PhysicsState, velocity: Array, close: Array) -> PhysicsState:
    """See ``physics.Physics.step``."""
    arrays = {name: getattr(state, name) for name in STATE_FIELDS}
    arrays |= {k: v for k, v in sorted(state.fields.items()) if _affects_physics(k)}
    after = {}
    if state.command is not None:
      arrays["command"] = state.command
      after["command"] = jnp.concatenate([velocity, close[:, None]], axis=-1)
    names = tuple(arrays)
    digest = hashlib.sha256(" ".join(names).encode()).hexdigest()[:16]
    target = f"apnpql_native_{self.scene.fingerprint}_{self._substeps}_{digest}"
    host_call.register(target, functools.partial(self._step_host, names))
    shapes = [
      jax.ShapeDtypeStruct(arrays[k].shape, arrays[k].dtype) for k in STATE_FIELDS
    ]
    moved = host_call.call(target, shapes, *arrays.values(), velocity, close)
    return state.replace(**dict(zip(STATE_FIELDS, moved, strict=True)), **after)

  def _new_batch(self, worlds: int, names: tuple[str, ...]) -> mujoco_batch.Batch:
    """Returns worlds of the scene; those of other ``names`` would keep their fields."""
    del names
    return mujoco_batch.Batch(self.scene.model, nsim=worlds, persistent=True)

  def _step_host(self, names: tuple[str, ...], *arrays: np.ndarray) -> list[np.ndarray]:
    """Returns the new ``STATE_FIELDS``; ``arrays`` end with velocities and gripper."""
    *loaded, velocity, close = arrays
    command = np.concatenate([velocity, close[:, None]], axis=-1)
    with self._lock:
      batch, control = self._batch(len(command), names), {}
      for name, value in zip(names, loaded, strict=True):
        if name in _CONTROL:
          control[name] = value
          continue
        target = getattr(batch, name) if name in STATE_FIELDS else batch.expand(name)
        target[...] = value
      self._advance(batch, command, control)
      return [np.array(getattr(batch, name), np.float32) for name in STATE_FIELDS]

  def _advance(self, batch, command, control) -> None:
    scene, arm, limit = self.scene, self.scene.arm_dof, self._torque_limit
    mass, bias = batch.bind("M"), batch.bind("qfrc_bias")
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    stage = int(mujoco.mjtStage.mjSTAGE_VEL)
    batch.forward(stage=stage)
    speed = control.get("gripper_speed", motors.GRIPPER_SPEED)
    for substep in range(self._substeps):
      now = command
      if "command" in control:
        late = np.less(substep, control["control_delay"])
        now = np.where(late[:, None], control["command"], command)
      ctrl[:, :6] = motors.arm_torque(
        mass[:, self._mass_index], bias[:, arm], qvel[:, arm], now[:, :6], limit
      )
      angle, rate = qpos[:, scene.gripper_qpos], qvel[:, scene.gripper_dof]
      ctrl[:, 6] = motors.gripper_torque(angle, rate, now[:, 6], np, speed=speed)
      batch.step(stage=stage)


def _affects_physics(field: str) -> bool:
  """Returns whether the engine needs a field of ``PhysicsState.fields``."""
  is_model = field not in physics.OWN_FIELDS and not field.startswith(_VISUAL)
  return is_model or field in _CONTROL


def _mass_index(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
  """Returns int[n, n]: where the sparse ``data.M`` holds the block of ``dofs``."""
  index = np.zeros((len(dofs), len(dofs)), np.int64)
  for row, i in enumerate(dofs):
    start, count = model.M_rowadr[i], model.M_rownnz[i]
    columns = list(model.M_colind[start : start + count])
    for column, j in enumerate(dofs[: row + 1]):
      index[row, column] = index[column, row] = start + columns.index(j)
  return index
