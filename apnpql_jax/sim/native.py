"""C MuJoCo engine: a batch of worlds on threads, reached from inside jit.

On a bare CPU it is ten to a hundred times faster than MJX on contact-rich
scenes. Compiled code calls it by name, see ``host_call``.
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

from apnpql_jax.sim import host_call, physics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array

_STATE_FIELDS = (
  "qpos",
  "qvel",
  "qacc_warmstart",
  "mocap_pos",
  "mocap_quat",
  "time",
)
_CONTROL = ("gripper_speed", "control_delay", "command")
_UNFELT = ("cam_", "light_", "geom_rgba")
"""Beginnings of names of model fields that physics need not be told of."""


class NativePhysics:
  """Worlds advanced by ``mujoco.batch``; see ``physics.Physics``.

  The batch object is scratch space: every call loads the whole state, so the
  mapping from state to state is pure.
  """

  name = "native"

  def __init__(self, scene: Scene, *, substeps: int):
    """
    Args:
      scene: the scene all worlds share.
      substeps: physics steps per control period.
    """
    self.scene = scene
    self._substeps = substeps
    self._torque_limit = scene.model.actuator_ctrlrange[:6, 1].copy()
    self._mass_index = _mass_index(scene.model, scene.arm_dof)
    self._lock = threading.Lock()

  def step(self, state: PhysicsState, velocity: Array, close: Array) -> PhysicsState:
    """See ``physics.Physics.step``."""
    arrays = {name: getattr(state, name) for name in _STATE_FIELDS}
    arrays |= {k: v for k, v in sorted(state.fields.items()) if _is_felt(k)}
    after = {}
    if state.command is not None:
      arrays["command"] = state.command
      after["command"] = jnp.concatenate([velocity, close[:, None]], axis=-1)
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays.values()]
    call = self._register(tuple(arrays))
    moved = host_call.call(
      call, shapes[: len(_STATE_FIELDS)], *arrays.values(), velocity, close
    )
    return state.replace(**dict(zip(_STATE_FIELDS, moved, strict=True)), **after)

  def _register(self, names: tuple[str, ...]) -> str:
    """The name of the call that is given worlds as arrays of these names."""
    digest = hashlib.sha256(" ".join(names).encode()).hexdigest()[:16]
    call = f"apnpql_native_{self.scene.fingerprint}_{self._substeps}_{digest}"
    host_call.register(call, functools.partial(self._step_host, names))
    return call

  @functools.lru_cache(maxsize=4)  # noqa: B019 - lives as long as the engine
  def _batch(self, worlds: int) -> mujoco_batch.Batch:
    return mujoco_batch.Batch(self.scene.model, nsim=worlds, persistent=True)

  def _step_host(self, names: tuple[str, ...], *arrays: np.ndarray) -> list[np.ndarray]:
    """Worlds given by name, then velocities and gripper; returns ``_STATE_FIELDS``."""
    *loaded, velocity, close = arrays
    command = np.concatenate([velocity, close[:, None]], axis=-1)
    with self._lock:
      batch, control = self._batch(len(command)), {}
      for name, value in zip(names, loaded, strict=True):
        if name in _CONTROL:
          control[name] = value
          continue
        held = getattr(batch, name) if name in _STATE_FIELDS else batch.expand(name)
        held[...] = value
      self._advance(batch, command, control)
      return [np.array(getattr(batch, name), np.float32) for name in _STATE_FIELDS]

  def _advance(self, batch, command, control) -> None:
    scene, arm = self.scene, self.scene.arm_dof
    mass, bias = batch.bind("M"), batch.bind("qfrc_bias")
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    stage = int(mujoco.mjtStage.mjSTAGE_VEL)
    batch.forward(stage=stage)
    speed = control.get("gripper_speed", physics.GRIPPER_SPEED)
    for substep in range(self._substeps):
      now = command
      if "command" in control:
        late = np.less(substep, control["control_delay"])
        now = np.where(late[:, None], control["command"], command)
      ctrl[:, :6] = physics.arm_torque(
        mass[:, self._mass_index],
        bias[:, arm],
        qvel[:, arm],
        now[:, :6],
        self._torque_limit,
      )
      ctrl[:, 6] = physics.gripper_torque(
        qpos[:, scene.gripper_qpos],
        qvel[:, scene.gripper_dof],
        now[:, 6],
        np,
        speed=speed,
      )
      batch.step(stage=stage)


def _is_felt(field: str) -> bool:
  """Whether physics need be told of a field of ``PhysicsState``."""
  own = field in physics.OWN_FIELDS and field not in _CONTROL
  return not own and not field.startswith(_UNFELT)


def _mass_index(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
  """int[n, n], where the dense block of ``dofs`` lies in the sparse ``data.M``."""
  index = np.zeros((len(dofs), len(dofs)), np.int64)
  for row, i in enumerate(dofs):
    start, count = model.M_rowadr[i], model.M_rownnz[i]
    columns = list(model.M_colind[start : start + count])
    for column, j in enumerate(dofs[: row + 1]):
      index[row, column] = index[column, row] = start + columns.index(j)
  return index
