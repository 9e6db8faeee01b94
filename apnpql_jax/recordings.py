"""Recorded joint trajectories to demonstrations.

A recording knows where the joints and the objects were; velocities and actions follow
from it. Images are never taken over: they are drawn again from the poses, as the
worlds of training draw theirs.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from apnpql_jax import demonstrations, memory, npz
from apnpql_jax.config import ConfigError
from apnpql_jax.demonstrations import Demonstrations
from apnpql_jax.sim.physics import MAX_VELOCITY
from apnpql_jax.sim.scene import Scene

_STILL = 0.02
"""Share of the gripper's travel per period below which its command is held."""

_FINGERS = ("finger_r1", "finger_r2", "finger_l1", "finger_l2")


def convert(path: Path, scene: Scene, *, period_s: float) -> Demonstrations:
  """Reads a recording and samples it once per control period.

  Args:
    path: the recording, an ``.npz`` as ``docs/demonstrations.md`` describes it.
    scene: gives the bodies whose poses are needed.
    period_s: control period, s.

  Raises:
    ConfigError: poses are missing, a shape is wrong, or the arm moves faster than it
      may.
  """
  arrays = npz.read(path, limit=memory.host_memory() or 1 << 32)
  bodies = _bodies(scene.model)
  missing = sorted(bodies.keys() - arrays.keys())
  if missing:
    raise ConfigError(
      f"{path} lacks the poses of {', '.join(missing)}: rewards, labels and images are "
      "made from them, and joint angles or pictures alone do not tell them"
    )
  shapes = {"time": (), "joints": (6,), "gripper": (), **dict.fromkeys(bodies, (7,))}
  if unknown := sorted(arrays.keys() - shapes.keys() - {"episode", "variant"}):
    raise ConfigError(f"{path} has unknown arrays {unknown}; known: {sorted(shapes)}")
  count = arrays["time"].shape[:1] if "time" in arrays else ()
  for name, shape in shapes.items():
    array = arrays.get(name)
    if array is None or array.dtype.kind not in "fiu" or array.shape != count + shape:
      raise ConfigError(f"{path}: {name} must be numbers of shape {['n', *shape]}")
    arrays[name] = np.asarray(array, np.float64)
    if not np.isfinite(arrays[name]).all():
      raise ConfigError(f"{path}: {name} is not finite")
  episode = np.asarray(arrays.get("episode", np.zeros(count, int)))
  if not count or episode.shape != count:
    raise ConfigError(f"{path}: episode must have shape ['n']")
  starts = np.flatnonzero(np.append(True, episode[1:] != episode[:-1]))
  parts = [
    _episode({name: arrays[name][rows] for name in shapes}, scene, period_s, path)
    for rows in map(slice, starts, [*starts[1:], count[0]])
  ]
  variant = int(np.asarray(arrays.get("variant", 0)).reshape(-1)[0])
  demos = Demonstrations(*(np.concatenate(x) for x in zip(*parts, strict=True)))
  demos = demos._replace(variant=np.full(demos.instants, variant, np.int32))
  demonstrations.check(demos, scene)
  return demos


def _episode(
  recorded: dict[str, np.ndarray], scene: Scene, period_s: float, path: Path
) -> Demonstrations:
  """One episode, whose time must increase."""
  model, time = scene.model, recorded["time"]
  if len(time) < 2 or (np.diff(time) <= 0).any():
    raise ConfigError(f"{path}: time must increase within an episode")
  at = np.arange(time[0], time[-1] + 1e-9, period_s)
  poses = {name: _at(at, time, recorded[name]) for name in recorded if name != "time"}
  for name in _bodies(model):
    poses[name][:, 3:] /= np.linalg.norm(poses[name][:, 3:], axis=1, keepdims=True)
  n = len(at)
  qpos = np.tile(model.qpos0, (n, 1))
  qpos[:, scene.arm_qpos] = poses["joints"]
  closed = poses["gripper"].clip(0.0, 1.0)
  for finger in _FINGERS:
    joint = model.joint(finger)
    qpos[:, joint.qposadr[0]] = closed * joint.range[1]
  mocap_pos, mocap_quat = np.zeros((n, model.nmocap, 3)), np.zeros((n, model.nmocap, 4))
  for name, (kind, index) in _bodies(model).items():
    if kind == "free":
      qpos[:, index : index + 7] = poses[name]
    else:
      mocap_pos[:, index], mocap_quat[:, index] = np.split(poses[name], [3], axis=1)
  action = np.zeros((n, 7), np.float32)
  velocity = np.diff(poses["joints"], axis=0) / period_s
  if abs(velocity).max(initial=0.0) > 1.05 * MAX_VELOCITY:
    raise ConfigError(
      f"{path}: the arm moves at {abs(velocity).max():.2f} rad/s, but no action goes "
      f"beyond {MAX_VELOCITY}; record it slower"
    )
  action[:-1, :6] = velocity.clip(-MAX_VELOCITY, MAX_VELOCITY)
  action[:, 6] = _commands(closed)
  first = np.arange(n) == 0
  return Demonstrations(
    *(np.asarray(x, np.float32) for x in (qpos, _velocities(model, qpos, period_s))),
    *(np.asarray(x, np.float32) for x in (mocap_pos, mocap_quat)),
    np.zeros(n, np.int32),
    action,
    first,
  )


def _at(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
  """Columns of ``values`` [n, ...], linear between the times recorded."""
  columns = values.reshape(len(time), -1).copy()
  if columns.shape[1] == 7:  # Poses: q and -q are the same rotation.
    for i in range(1, len(columns)):
      if columns[i, 3:] @ columns[i - 1, 3:] < 0:
        columns[i, 3:] *= -1
  sampled = np.stack([np.interp(at, time, column) for column in columns.T], axis=1)
  return sampled.reshape(len(at), *values.shape[1:])


def _commands(closed: np.ndarray) -> np.ndarray:
  """f32[n] in {0, 1}: closes while it closes, opens while it opens, else is held."""
  command = np.zeros(len(closed), np.float32)
  present = float(closed[0] > 0.5)
  for i, change in enumerate(np.diff(closed, append=closed[-1])):
    if abs(change) > _STILL:
      present = float(change > 0)
    command[i] = present
  return command


def _velocities(model: mujoco.MjModel, qpos: np.ndarray, period_s: float) -> np.ndarray:
  """f64[n, nv], towards the next instant; the last one keeps that before it."""
  qvel = np.zeros((len(qpos), model.nv))
  for i in range(len(qpos) - 1):
    mujoco.mj_differentiatePos(model, qvel[i], period_s, qpos[i], qpos[i + 1])
  qvel[-1] = qvel[-2] if len(qvel) > 1 else 0.0
  return qvel


def _bodies(model: mujoco.MjModel) -> dict[str, tuple[str, int]]:
  """Body -> how its pose is held, and where: all that a recording must tell."""
  bodies = {}
  for i in range(model.nbody):
    name, joint = model.body(i).name, model.body_jntadr[i]
    if model.body_mocapid[i] >= 0:
      bodies[name] = ("mocap", int(model.body_mocapid[i]))
    elif joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
      bodies[name] = ("free", int(model.jnt_qposadr[joint]))
  return bodies
