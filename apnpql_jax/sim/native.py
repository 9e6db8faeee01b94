"""C MuJoCo engine: a batch of worlds on threads, reached from inside jit.

On a bare CPU it is ten to a hundred times faster than MJX on contact-rich
scenes. Compiled code calls it by name, see ``host_call``.
"""

from __future__ import annotations

import functools
import threading

import jax
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
    self._fields = (*_STATE_FIELDS, *sorted(scene.variants))
    self._call = f"apnpql_native_{scene.fingerprint}_{substeps}"
    host_call.register(self._call, self._step_host)

  def step(self, state: PhysicsState, velocity: Array, close: Array) -> PhysicsState:
    """See ``physics.Physics.step``."""
    arrays = {name: getattr(state, name) for name in _STATE_FIELDS} | state.fields
    ordered = [arrays[name] for name in self._fields]
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in ordered]
    moved = host_call.call(
      self._call, shapes[: len(_STATE_FIELDS)], *ordered, velocity, close
    )
    return state.replace(**dict(zip(_STATE_FIELDS, moved, strict=True)))

  @functools.lru_cache(maxsize=4)  # noqa: B019 - lives as long as the engine
  def _batch(self, worlds: int) -> mujoco_batch.Batch:
    return mujoco_batch.Batch(self.scene.model, nsim=worlds, persistent=True)

  def _step_host(self, *arrays: np.ndarray) -> list[np.ndarray]:
    *state, velocity, close = arrays
    with self._lock:
      batch = self._batch(len(velocity))
      for name, value in zip(self._fields, state, strict=True):
        held = getattr(batch, name) if name in _STATE_FIELDS else batch.expand(name)
        held[...] = value
      self._advance(batch, velocity, close)
      return [np.array(getattr(batch, name), np.float32) for name in _STATE_FIELDS]

  def _advance(self, batch, velocity, close) -> None:
    scene, arm = self.scene, self.scene.arm_dof
    mass, bias = batch.bind("M"), batch.bind("qfrc_bias")
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    stage = int(mujoco.mjtStage.mjSTAGE_VEL)
    batch.forward(stage=stage)
    for _ in range(self._substeps):
      ctrl[:, :6] = physics.arm_torque(
        mass[:, self._mass_index],
        bias[:, arm],
        qvel[:, arm],
        velocity,
        self._torque_limit,
      )
      ctrl[:, 6] = physics.gripper_torque(
        qpos[:, scene.gripper_qpos], qvel[:, scene.gripper_dof], close, np
      )
      batch.step(stage=stage)


def _mass_index(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
  """int[n, n], where the dense block of ``dofs`` lies in the sparse ``data.M``."""
  index = np.zeros((len(dofs), len(dofs)), np.int64)
  for row, i in enumerate(dofs):
    start, count = model.M_rowadr[i], model.M_rownnz[i]
    columns = list(model.M_colind[start : start + count])
    for column, j in enumerate(dofs[: row + 1]):
      index[row, column] = index[column, row] = start + columns.index(j)
  return index
