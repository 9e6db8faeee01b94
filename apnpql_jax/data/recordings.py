"""Conversion of recorded joint trajectories to demonstrations.

A recording holds the positions of the joints and the poses of the objects. Velocities,
actions and images are computed from them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.data import demonstrations, npz
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.motors import MAX_VELOCITY
from apnpql_jax.sim.names import ARM_JOINTS, BASE_SITE
from apnpql_jax.sim.scene import Scene, free_joints

_CONVENTIONS: dict[str, dict[str, Any]] = {
  "time_unit": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
  "angle_unit": {"rad": 1.0, "deg": math.pi / 180},
  "length_unit": {"m": 1.0, "mm": 1e-3},
  "quaternion_order": {"wxyz": [0, 1, 2, 3], "xyzw": [3, 0, 1, 2]},
  "frame": {"world": False, "base": True},
}
"""Array of text -> its valid values, each with what it stands for."""

_BEYOND = 0.05  # share of the gripper's range that a reading may lie outside of it
_ROUNDING = 1e-3  # periods; a remainder below this is rounding of the clock
_STILL = 0.02  # change per period of the gripper (0 to 1) that keeps its command
_LONGEST_GAP_S = 1.0  # between two samples; interpolated
_LARGEST = 1e30  # magnitude of a number, far below the limit of float32
_FINGERS = ("finger_r1", "finger_r2", "finger_l1", "finger_l2")


def convert(path: Path, scene: Scene, *, period_s: float) -> Demonstrations:
  """Reads a recording (``docs/demonstrations.md``) and samples it every ``period_s``.

  Raises:
    FileError: Poses or conventions are missing, a shape is wrong, a value is out of
      range, or the arm moves too fast.
  """
  arrays = npz.read(path, limit=runtime.host_memory() or 1 << 32)
  try:
    return convert_arrays(arrays, scene, period_s=period_s)
  except UserError as error:
    raise FileError(f"{path}: {error}") from None


def convert_arrays(
  arrays: dict[str, np.ndarray], scene: Scene, *, period_s: float
) -> Demonstrations:
  """Samples the arrays of a recording every ``period_s``; see ``convert``."""
  recorded = _read(arrays, scene)
  variant, episode = recorded.pop("variant"), recorded.pop("episode")
  starts = np.flatnonzero(np.append(True, episode[1:] != episode[:-1]))
  parts = [
    _episode({name: array[rows] for name, array in recorded.items()}, scene, period_s)
    for rows in map(slice, starts, [*starts[1:], len(episode)])
  ]
  demos = demonstrations.join(*parts)
  demos = demos._replace(variant=np.full(demos.instants, variant))
  demonstrations.check(demos, scene)
  return demos._replace(variant=demos.variant.astype(np.int32))


def tracked(scene: Scene) -> tuple[list[str], list[str]]:
  """Returns the bodies and the joints of objects that a recording must cover."""
  return list(_bodies(scene.model)), list(_joints(scene))


def _read(arrays: dict[str, np.ndarray], scene: Scene) -> dict[str, np.ndarray]:
  """Returns the numbers, f64[n, ...], in the project's units, orders and frame."""
  bodies, joints = _bodies(scene.model), _joints(scene)
  shapes: dict[str, tuple[int, ...]] = {"time": (), "joints": (6,), "gripper": ()}
  shapes |= dict.fromkeys(bodies, (7,)) | dict.fromkeys(joints, ())
  for what, needed in (("poses of", bodies), ("positions of the joints", joints)):
    if missing := sorted(needed.keys() - arrays.keys()):
      raise FileError(
        f"it lacks the {what} {', '.join(missing)}, from which rewards, labels and "
        "images are computed; record them with the joint angles"
      )
  named = {*_CONVENTIONS, "joint_names", "gripper_range"}
  npz.check_names(arrays.keys() - {"episode", "variant"}, shapes.keys() | named)
  count = arrays["time"].shape[:1]
  numbers = {}
  for name, shape in shapes.items():
    array = arrays[name]
    if array.dtype.kind not in "fiu" or not count or array.shape != count + shape:
      expected = f"numbers of shape {['n', *shape]}, with one n for all arrays"
      raise FileError(
        f"{name} is {array.dtype}{list(array.shape)}; it must be {expected}"
      )
    numbers[name] = array = np.asarray(array, np.float64)
    if not (abs(array) < _LARGEST).all():
      raise FileError(f"{name} is not finite")
  chosen = {name: _convention(arrays, name) for name in _CONVENTIONS}
  numbers["time"] = numbers["time"] * chosen["time_unit"]
  angles = numbers["joints"] * chosen["angle_unit"]
  numbers["joints"] = angles[:, _joint_order(arrays["joint_names"])]
  numbers["gripper"] = _closed(numbers["gripper"], arrays["gripper_range"])
  for name in bodies:
    where, quat = np.split(numbers[name], [3], axis=1)
    if (abs(np.linalg.norm(quat, axis=1) - 1) > 0.1).any():
      raise FileError(f"a quaternion of {name} is not of unit length")
    where, quat = where * chosen["length_unit"], quat[:, chosen["quaternion_order"]]
    if chosen["frame"]:
      where, quat = _from_base(scene, where, quat)
    numbers[name] = np.concatenate([where, quat], axis=1)
  for name, (unit, _) in joints.items():
    numbers[name] = numbers[name] * chosen[unit]
  numbers["episode"] = arrays.get("episode", np.zeros(count))
  if numbers["episode"].shape != count:
    raise FileError("episode must have shape ['n']")
  numbers["variant"] = variant = arrays.get("variant", np.zeros((), int))
  if variant.shape or variant.dtype.kind not in "iu":
    raise FileError("variant must be one whole number")
  return numbers


def _convention(arrays: dict[str, np.ndarray], name: str) -> Any:
  """Returns what the text in array ``name`` stands for."""
  array, valid = arrays[name], _CONVENTIONS[name]
  text = _texts(array.reshape(-1))[0] if array.size == 1 else ""
  if text not in valid:
    raise FileError(f"{name} must be one of the texts {', '.join(valid)}")
  return valid[text]


def _joint_order(names: np.ndarray) -> list[int]:
  """Returns the columns of ``ARM_JOINTS``, whose names may have a prefix and suffix."""
  texts = [text.removesuffix("_joint") for text in _texts(names.reshape(-1))]
  columns = [
    [i for i, text in enumerate(texts) if text.endswith(joint)] for joint in ARM_JOINTS
  ]
  if len(texts) != len(ARM_JOINTS) or any(len(found) != 1 for found in columns):
    raise FileError(
      f"joint_names must name the columns of joints: {', '.join(ARM_JOINTS)}, in their "
      "order"
    )
  return [found[0] for found in columns]


def _closed(readings: np.ndarray, limits: np.ndarray) -> np.ndarray:
  """Returns how far the gripper is closed, f64[n] in [0, 1]."""
  usable = limits.shape == (2,) and limits.dtype.kind in "fiu"
  if not usable or not np.isfinite(limits).all() or limits[0] == limits[1]:
    raise FileError("gripper_range must be the readings of an open and a closed hand")
  opened, closed = map(float, limits)
  share = (readings - opened) / (closed - opened)
  if (off := (share < -_BEYOND) | (share > 1 + _BEYOND)).any():
    i = int(off.argmax())
    raise FileError(
      f"gripper reads {readings[i]:g} at sample {i}, outside of gripper_range "
      f"({opened:g} open, {closed:g} closed)"
    )
  return share.clip(0.0, 1.0)


def _from_base(
  scene: Scene, where: np.ndarray, quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Converts poses from the frame of the arm's controller to that of the scene."""
  data = mujoco.MjData(scene.model)
  mujoco.mj_kinematics(scene.model, data)
  base, turn, turned = data.site(BASE_SITE), np.zeros(4), np.zeros(quat.shape)
  mujoco.mju_mat2Quat(turn, base.xmat)
  for result, q in zip(turned, np.ascontiguousarray(quat), strict=True):
    mujoco.mju_mulQuat(result, turn, q)
  return base.xpos + where @ base.xmat.reshape(3, 3).T, turned


def _texts(array: np.ndarray) -> list[str]:
  """Returns the texts of an array; bytes are decoded, and other types give none."""
  if array.dtype.kind == "S":
    array = np.char.decode(array, "ascii", "replace")
  return array.tolist() if array.dtype.kind == "U" else [""] * array.size


def _episode(
  recorded: dict[str, np.ndarray], scene: Scene, period_s: float
) -> Demonstrations:
  """Samples one episode at the control period."""
  model, time = scene.model, recorded["time"] - recorded["time"][0]
  steps = np.diff(time)
  if not len(steps):
    raise FileError("an episode has only one sample")
  if (steps <= 0).any():
    raise FileError(
      "time must increase within an episode (Unix time needs float64 or integers)"
    )
  if steps.max() > _LONGEST_GAP_S:
    raise FileError(
      f"two samples are {steps.max():.3g} s apart, more than {_LONGEST_GAP_S} s; "
      "correct time_unit, or start a new episode there"
    )
  at = _instants(time[-1], period_s)
  poses = {name: _at(at, time, recorded[name]) for name in recorded if name != "time"}
  qpos, mocap_pos, mocap_quat = _positions(poses, scene)
  states = (qpos, _velocities(model, qpos, period_s), mocap_pos, mocap_quat)
  return Demonstrations(
    *(np.asarray(x, np.float32) for x in states),
    variant=np.zeros(len(at), np.int32),
    action=_actions(poses["joints"], poses["gripper"], period_s),
    first=np.arange(len(at)) == 0,
  )


def _instants(duration_s: float, period_s: float) -> np.ndarray:
  """Returns the instants f64[n], s: whole periods before the last sample.

  A task is solved at the end, so that instant is kept, wherever the recording starts.
  The first period may begin before the first sample, which it repeats.
  """
  count = max(1, math.ceil(duration_s / period_s - _ROUNDING))
  return (duration_s - period_s * np.arange(count, -1, -1)).clip(0.0)


def _positions(
  poses: dict[str, np.ndarray], scene: Scene
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns qpos f64[n, nq], mocap_pos f64[n, nmocap, 3], mocap_quat [n, nmocap, 4]."""
  model, n = scene.model, len(poses["joints"])
  qpos = np.tile(model.qpos0, (n, 1))
  qpos[:, scene.arm_qpos] = poses["joints"]
  for joint in map(model.joint, _FINGERS):
    qpos[:, joint.qposadr[0]] = poses["gripper"] * joint.range[1]
  mocap_pos, mocap_quat = np.zeros((n, model.nmocap, 3)), np.zeros((n, model.nmocap, 4))
  for name, (kind, index) in _bodies(model).items():
    where, quat = np.split(poses[name], [3], axis=1)
    quat = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    if kind == "free":
      qpos[:, index : index + 7] = np.concatenate([where, quat], axis=1)
    else:
      mocap_pos[:, index], mocap_quat[:, index] = where, quat
  for name, (_, address) in _joints(scene).items():
    qpos[:, address] = poses[name]
  return qpos, mocap_pos, mocap_quat


def _actions(joints: np.ndarray, gripper: np.ndarray, period_s: float) -> np.ndarray:
  """Returns the actions f32[n, 7] that lead from each instant to the next."""
  action = np.zeros((len(joints), 7), np.float32)
  velocity = np.diff(joints, axis=0) / period_s
  if abs(velocity).max(initial=0.0) > 1.05 * MAX_VELOCITY:
    raise FileError(
      f"the arm moves at {abs(velocity).max():.2f} rad/s, but actions are limited to "
      f"{MAX_VELOCITY} rad/s; correct angle_unit or time_unit, or record it more slowly"
    )
  action[:-1, :6] = velocity.clip(-MAX_VELOCITY, MAX_VELOCITY)
  action[:, 6] = _commands(gripper)
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
  """Maps each body that a recording must cover to its kind and its index.

  Raises:
    FileError: A body has no name.
  """
  bodies = {}
  for i in range(model.nbody):
    name, joint = model.body(i).name, model.body_jntadr[i]
    if model.body_mocapid[i] >= 0:
      bodies[name] = ("mocap", int(model.body_mocapid[i]))
    elif joint in free_joints(model):
      bodies[name] = ("free", int(model.jnt_qposadr[joint]))
  if "" in bodies:
    raise FileError(
      "a body of the scene that can move has no name, for its array in recordings"
    )
  return bodies


def _joints(scene: Scene) -> dict[str, tuple[str, int]]:
  """Maps each joint of an object to its unit and address in qpos, free joints left out.

  Raises:
    FileError: A joint has no name of its own, or is a ball.
  """
  model, joints = scene.model, {}
  taken = {"time", "joints", "gripper", "episode", "variant", *_bodies(model)}
  taken |= {*_CONVENTIONS, "joint_names", "gripper_range"}
  robot = model.body_rootid[model.body("base").id]
  units = {
    mujoco.mjtJoint.mjJNT_HINGE: "angle_unit",
    mujoco.mjtJoint.mjJNT_SLIDE: "length_unit",
  }
  for i in range(model.njnt):
    kind, name = mujoco.mjtJoint(model.jnt_type[i]), model.joint(i).name
    if model.body_rootid[model.jnt_bodyid[i]] == robot or i in free_joints(model):
      continue
    where = (
      f"{scene.name}.xml: joint {name!r} of {model.body(model.jnt_bodyid[i]).name}"
    )
    if kind not in units:
      raise FileError(f"{where} is a ball joint, which recordings cannot have")
    if not name or name in taken:
      raise FileError(f"{where} needs a name of its own, for its array in recordings")
    joints[name] = (units[kind], int(model.jnt_qposadr[i]))
  return joints
