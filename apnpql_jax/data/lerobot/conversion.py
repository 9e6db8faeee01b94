"""Conversion of demonstrations to the columns of a dataset, and back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from apnpql_jax.data import demonstrations, recordings
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.lerobot.layout import ENVIRONMENT, TIMES
from apnpql_jax.data.lerobot.reader import Dataset, Episode, read
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.names import ARM_JOINTS, GRIPPER_JOINT
from apnpql_jax.sim.scene import Scene

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_FREE, _BALL = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
_VARIANT = "variant"
_PERIOD_TOLERANCE = 1e-3  # of a control period


def state_names(scene: Scene) -> list[str]:
  """Returns the names of the numbers in a state: positions, velocities, variant."""
  return [*_position_names(scene.model), *_velocity_names(scene.model), _VARIANT]


def states(
  qpos: np.ndarray,
  qvel: np.ndarray,
  mocap_pos: np.ndarray,
  mocap_quat: np.ndarray,
  variant: np.ndarray,
) -> np.ndarray:
  """Returns n states f32[n, k] in the order of ``state_names``; see Demonstrations."""
  mocap = np.concatenate([mocap_pos, mocap_quat], axis=-1).reshape(len(qpos), -1)
  parts = [qpos, mocap, qvel, variant[:, None]]
  return np.concatenate(parts, axis=1).astype(np.float32)


def convert(folder: Path, scene: Scene, *, period_s: float) -> Demonstrations:
  """Reads a dataset as demonstrations.

  A dataset with whole states, as ``apnpql collect`` writes it, gives the demonstrations
  that it was made from. So does the log of a simulated robot; where its policy was late
  and dropped a period, a new episode begins. One with poses only is converted like a
  recording, see ``recordings``.

  Raises:
    FileError: The folder is not a dataset, is damaged, holds no poses of the objects,
      or does not fit the scene.
  """
  dataset = read(folder)
  try:
    if not dataset.episodes:
      raise FileError("it has no episodes")
    names = dataset.names.get(ENVIRONMENT)
    if names is None:
      raise FileError(
        f"it has no {ENVIRONMENT}, the poses of the objects, from which rewards, "
        "labels and images are computed"
      )
    if set(names) >= set(state_names(scene)):
      return _exact(dataset, scene, period_s)
    return _from_poses(dataset, scene, period_s)
  except UserError as error:
    raise FileError(f"{str(folder)!r}: {error}") from None


def _exact(dataset: Dataset, scene: Scene, period_s: float) -> Demonstrations:
  """Returns demonstrations from whole states, one control period apart."""
  if abs(1 / dataset.fps / period_s - 1) > _PERIOD_TOLERANCE:
    raise FileError(
      f"its frames are {1 / dataset.fps:.4g} s apart, not {period_s} s, the control "
      "period of the task"
    )
  model, rows = scene.model, _column(dataset, state_names(scene)).astype(np.float32)
  ends = np.cumsum([model.nq, 7 * model.nmocap, model.nv])
  qpos, mocap, qvel, variant = np.split(rows, ends, axis=1)
  mocap = mocap.reshape(len(rows), model.nmocap, 7)
  action = np.concatenate([x.actions for x in dataset.episodes])
  times = [_times(dataset, x) for x in dataset.episodes]
  first = np.concatenate([_begins(x, period_s) for x in times])
  demos = Demonstrations(
    qpos=qpos,
    qvel=qvel,
    mocap_pos=mocap[..., :3],
    mocap_quat=mocap[..., 3:],
    variant=variant[:, 0].astype(np.int32),
    action=action.astype(np.float32),
    first=first,
  )
  demonstrations.check(demos, scene)
  return demos


def _times(dataset: Dataset, episode: Episode) -> np.ndarray:
  """Returns the times of frames f64[n], s, in whole periods of the dataset.

  A log has measured ones, which tell where a policy was late and dropped periods.
  """
  names = dataset.names.get(TIMES, [])
  if "joints" not in names:
    return episode.time
  measured = episode.columns[TIMES][:, names.index("joints")]
  return np.round((measured - measured[0]) * dataset.fps) / dataset.fps


def _begins(times: np.ndarray, period_s: float) -> np.ndarray:
  """Returns bool[n]: where instants begin that are one control period apart.

  After a dropped period they are not: the arm has held, or followed an older action.
  """
  return np.append(True, abs(np.diff(times) / period_s - 1) > 0.5)


def _from_poses(dataset: Dataset, scene: Scene, period_s: float) -> Demonstrations:
  """Returns demonstrations from joint angles and poses of objects."""
  bodies, joints = recordings.tracked(scene)
  known = dataset.names[ENVIRONMENT]
  arrays = {
    "time": np.concatenate([_times(dataset, x) for x in dataset.episodes]),
    "joints": np.concatenate([x.joints for x in dataset.episodes]),
    "gripper": np.concatenate([x.gripper for x in dataset.episodes]),
    "episode": np.repeat(
      np.arange(len(dataset.episodes)), [len(x.time) for x in dataset.episodes]
    ),
    "time_unit": np.array("s"),
    "angle_unit": np.array("rad"),
    "length_unit": np.array("m"),
    "quaternion_order": np.array("wxyz"),
    "frame": np.array("world"),
    "joint_names": np.array(ARM_JOINTS),
    "gripper_range": scene.model.joint(GRIPPER_JOINT).range,
  }
  columns = {body: [f"{body}.{x}" for x in _POSE] for body in bodies}
  columns |= {joint: [f"{joint}.position"] for joint in joints}
  for name, wanted in columns.items():
    if set(wanted) <= set(known):
      values = _column(dataset, wanted)
      arrays[name] = values if name in bodies else values[:, 0]
  return recordings.convert_arrays(arrays, scene, period_s=period_s)


def _column(dataset: Dataset, names: list[str]) -> np.ndarray:
  """Returns numbers of the states of all episodes, by name, f64[n, len(names)]."""
  index = [dataset.names[ENVIRONMENT].index(name) for name in names]
  return np.concatenate([x.columns[ENVIRONMENT][:, index] for x in dataset.episodes])


def _position_names(model: mujoco.MjModel) -> list[str]:
  """Returns names of qpos, then of the poses of mocap bodies."""
  bodies = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :]
  poses = [f"{model.body(i).name}.{x}" for i in bodies for x in _POSE]
  return _state_names(model, _POSE, "position") + poses


def _velocity_names(model: mujoco.MjModel) -> list[str]:
  """Returns names of qvel."""
  return _state_names(model, _TWIST, "velocity")


def _state_names(model: mujoco.MjModel, parts: Sequence[str], single: str) -> list[str]:
  """Returns names for all joints: ``parts`` of a free joint, ``single`` of a hinge."""
  names = []
  for i in range(model.njnt):
    kind, joint = model.jnt_type[i], _joint_name(model, i)
    if kind == _FREE:
      names += [f"{model.body(model.jnt_bodyid[i]).name}.{x}" for x in parts]
    else:
      names += [f"{joint}.{x}" for x in (parts[3:] if kind == _BALL else (single,))]
  return names


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
  return model.joint(joint).name or f"joint_{joint}"
