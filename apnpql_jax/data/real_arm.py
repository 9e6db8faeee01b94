"""Conversion of recorded joint trajectories to demonstrations.

A recording holds the positions of the joints and the poses of the objects. Velocities,
actions and images are computed from them.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from apnpql_jax import devices
from apnpql_jax.data import demonstrations, npz
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.physics import MAX_VELOCITY
from apnpql_jax.sim.scene import Scene, free_joints

_STILL = 0.02  # change per period of the gripper (0 to 1) that keeps its command
_LONGEST_GAP_S = 1.0  # between two samples; interpolated
_LARGEST = 1e30  # magnitude of a number, far below the limit of float32
_FINGERS = ("finger_r1", "finger_r2", "finger_l1", "finger_l2")


def convert(path: Path, scene: Scene, *, period_s: float) -> Demonstrations:
  """Reads a recording (``docs/demonstrations.md``) and samples it every ``period_s``.

  Raises:
    FileError: Poses are missing, a shape is wrong, or the arm moves too fast.
  """
  arrays = _read(path, scene.model)
  variant, episode = arrays.pop("variant"), arrays.pop("episode")
  starts = np.flatnonzero(np.append(True, episode[1:] != episode[:-1]))
  try:
    parts = [
      _episode({name: array[rows] for name, array in arrays.items()}, scene, period_s)
      for rows in map(slice, starts, [*starts[1:], len(episode)])
    ]
    demos = Demonstrations(*(np.concatenate(x) for x in zip(*parts, strict=True)))
    demos = demos._replace(variant=np.full(demos.instants, variant))
    demonstrations.check(demos, scene)
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  return demos._replace(variant=demos.variant.astype(np.int32))


def _read(path: Path, model: mujoco.MjModel) -> dict[str, np.ndarray]:
  """Reads all arrays, f64[n, ...], with defaults for the optional ones."""
  arrays = npz.read(path, limit=devices.host_memory() or 1 << 32)
  bodies = _bodies(model)
  missing = sorted(bodies.keys() - arrays.keys())
  if missing:
    raise FileError(
      f"{path} lacks the poses of {', '.join(missing)}, from which rewards, labels and "
      "images are computed; record them with the joint angles"
    )
  shapes = {"time": (), "joints": (6,), "gripper": (), **dict.fromkeys(bodies, (7,))}
  if unknown := sorted(arrays.keys() - shapes.keys() - {"episode", "variant"}):
    raise FileError(f"{path} has unknown arrays {unknown}; known: {sorted(shapes)}")
  count = arrays["time"].shape[:1] if "time" in arrays else ()
  for name, shape in shapes.items():
    array = arrays.get(name)
    numbers = array is not None and array.dtype.kind in "fiu"
    if not numbers or not count or array.shape != count + shape:
      raise FileError(f"{path}: {name} must be numbers of shape {['n', *shape]}")
    arrays[name] = array = np.asarray(array, np.float64)
    if not (abs(array) < _LARGEST).all():
      raise FileError(f"{path}: {name} is not finite")
    off = abs(np.linalg.norm(array[:, 3:], axis=1) - 1) if name in bodies else 0.0
    if np.max(off, initial=0.0) > 0.1:
      raise FileError(f"{path}: a quaternion of {name} is not of unit length")
  if arrays.setdefault("episode", np.zeros(count)).shape != count:
    raise FileError(f"{path}: episode must have shape ['n']")
  variant = arrays.setdefault("variant", np.zeros((), int))
  if variant.shape or variant.dtype.kind not in "iu":
    raise FileError(f"{path}: variant must be one whole number")
  return arrays


def _episode(
  recorded: dict[str, np.ndarray], scene: Scene, period_s: float
) -> Demonstrations:
  """Samples one episode at the control period."""
  model, time = scene.model, recorded["time"]
  steps = np.diff(time)
  if not len(steps) or (steps <= 0).any():
    raise FileError("time must increase within an episode")
  if steps.max() > _LONGEST_GAP_S:
    raise FileError(
      f"two samples are {steps.max():.3g} s apart, more than {_LONGEST_GAP_S} s; "
      "start a new episode there"
    )
  at = np.arange(time[0], time[-1] + 1e-9, period_s)
  poses = {name: _at(at, time, recorded[name]) for name in recorded if name != "time"}
  qpos, mocap_pos, mocap_quat = _positions(poses, scene)
  states = (qpos, _velocities(model, qpos, period_s), mocap_pos, mocap_quat)
  return Demonstrations(
    *(np.asarray(x, np.float32) for x in states),
    variant=np.zeros(len(at), np.int32),
    action=_actions(poses["joints"], poses["gripper"], period_s),
    first=np.arange(len(at)) == 0,
  )


def _positions(
  poses: dict[str, np.ndarray], scene: Scene
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns qpos f64[n, nq], mocap_pos f64[n, nmocap, 3], mocap_quat [n, nmocap, 4]."""
  model, n = scene.model, len(poses["joints"])
  qpos = np.tile(model.qpos0, (n, 1))
  qpos[:, scene.arm_qpos] = poses["joints"]
  closed = poses["gripper"].clip(0.0, 1.0)
  for joint in map(model.joint, _FINGERS):
    qpos[:, joint.qposadr[0]] = closed * joint.range[1]
  mocap_pos, mocap_quat = np.zeros((n, model.nmocap, 3)), np.zeros((n, model.nmocap, 4))
  for name, (kind, index) in _bodies(model).items():
    where, quat = np.split(poses[name], [3], axis=1)
    quat = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    if kind == "free":
      qpos[:, index : index + 7] = np.concatenate([where, quat], axis=1)
    else:
      mocap_pos[:, index], mocap_quat[:, index] = where, quat
  return qpos, mocap_pos, mocap_quat


def _actions(joints: np.ndarray, gripper: np.ndarray, period_s: float) -> np.ndarray:
  """Returns the actions f32[n, 7] that lead from each instant to the next."""
  action = np.zeros((len(joints), 7), np.float32)
  velocity = np.diff(joints, axis=0) / period_s
  if abs(velocity).max(initial=0.0) > 1.05 * MAX_VELOCITY:
    raise FileError(
      f"the arm moves at {abs(velocity).max():.2f} rad/s, but actions are limited to "
      f"{MAX_VELOCITY} rad/s; record it more slowly"
    )
  action[:-1, :6] = velocity.clip(-MAX_VELOCITY, MAX_VELOCITY)
  action[:, 6] = _commands(gripper.clip(0.0, 1.0))
  return action


def _at(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
  """Interpolates ``values`` [n, ...] linearly at the times ``at``."""
  columns = values.reshape(len(time), -1).copy()
  if columns.shape[1] == 7:  # Poses: q and -q are the same rotation, choose the nearer.
    for i in range(1, len(columns)):
      if columns[i, 3:] @ columns[i - 1, 3:] < 0:
        columns[i, 3:] *= -1
  sampled = np.stack([np.interp(at, time, column) for column in columns.T], axis=1)
  return sampled.reshape(len(at), *values.shape[1:])


def _commands(closed: np.ndarray) -> np.ndarray:
  """Returns commands f32[n] in {0, 1}: 1 while closing, 0 while opening, else held."""
  command = np.zeros(len(closed), np.float32)
  present = float(closed[0] > 0.5)
  for i, change in enumerate(np.diff(closed, append=closed[-1])):
    if abs(change) > _STILL:
      present = float(change > 0)
    command[i] = present
  return command


def _velocities(model: mujoco.MjModel, qpos: np.ndarray, period_s: float) -> np.ndarray:
  """Returns velocities f64[n, nv] to the next instant; the last one is repeated."""
  qvel = np.zeros((len(qpos), model.nv))
  for i in range(len(qpos) - 1):
    mujoco.mj_differentiatePos(model, qvel[i], period_s, qpos[i], qpos[i + 1])
  qvel[-1] = qvel[-2] if len(qvel) > 1 else 0.0
  return qvel


def _bodies(model: mujoco.MjModel) -> dict[str, tuple[str, int]]:
  """Maps each body that a recording must cover to its kind and its index."""
  bodies = {}
  for i in range(model.nbody):
    name, joint = model.body(i).name, model.body_jntadr[i]
    if model.body_mocapid[i] >= 0:
      bodies[name] = ("mocap", int(model.body_mocapid[i]))
    elif joint in free_joints(model):
      bodies[name] = ("free", int(model.jnt_qposadr[joint]))
  return bodies
