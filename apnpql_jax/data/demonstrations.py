"""Demonstration files: episodes of states and actions, checked on reading.

Images, rewards and labels are computed from them; see ``docs/demonstrations.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apnpql_jax import devices
from apnpql_jax.atomic import replacing
from apnpql_jax.data import npz
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.scene import Scene, free_joints
from apnpql_jax.tasks.task import Task
from apnpql_jax.types import ACTION_DIM

FORMAT = "apnpql-demonstrations"
VERSION = 1
_SLACK = 0.05  # rad; tolerance beyond a joint limit, because MuJoCo's limits are soft


class Demonstrations(NamedTuple):
  """Episodes one after the other, in instants one control period apart."""

  qpos: np.ndarray  # f32[n, nq]
  qvel: np.ndarray  # f32[n, nv]
  mocap_pos: np.ndarray  # f32[n, nmocap, 3], m
  mocap_quat: np.ndarray  # f32[n, nmocap, 4]
  variant: np.ndarray  # i32[n]: variant of the scene
  action: np.ndarray  # f32[n, 7]; ignored at the last instant of an episode
  first: np.ndarray  # bool[n]: an episode begins here

  @property
  def instants(self) -> int:
    """Number of instants."""
    return len(self.first)


def save(
  path: Path, demos: Demonstrations, *, task: str, control_period_s: float
) -> dict[str, Any]:
  """Writes a demonstration file; returns its name and counts.

  Raises:
    FileError: The file cannot be written.
  """
  arrays: dict[str, Any] = {"format": FORMAT, "version": VERSION, "task": task}
  arrays |= {"control_period_s": control_period_s, **demos._asdict()}
  try:
    # NumPy appends a suffix to file names.
    with replacing(path) as part, part.open("wb") as file:
      np.savez_compressed(file, **arrays)
  except OSError as error:
    raise FileError(f"cannot write {path}: {error}") from None
  episodes = int(demos.first.sum())
  return {"file": str(path), "instants": demos.instants, "demonstrations": episodes}


def load(path: Path, task: Task, control_period_s: float) -> Demonstrations:
  """Reads and checks a demonstration file.

  Raises:
    FileError: The file has another format, version, task or control period, or an
      invalid state.
  """
  arrays = npz.read(path, limit=devices.host_memory() or 1 << 32)
  fields = Demonstrations._fields
  wanted = {"format", "version", "task", "control_period_s", *fields}
  if arrays.keys() != wanted:
    names = ", ".join(sorted(arrays.keys() ^ wanted))
    raise FileError(f"{path} lacks arrays or has extra ones: {names}")
  expected = {"format": FORMAT, "version": VERSION, "task": task.name}
  for name, value in expected.items():
    if str(arrays[name]) != str(value):
      raise FileError(f"{path} has {name} {_shorten(arrays[name])}, not {value}")
  period = arrays["control_period_s"]
  if period.shape or period.dtype.kind != "f" or abs(period - control_period_s) > 1e-6:
    raise FileError(
      f"{path} has control_period_s {_shorten(period)}, not {control_period_s}"
    )
  try:
    demos = Demonstrations(**{name: arrays[name] for name in fields})
    check(demos, task.scene)
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  return demos


def check(demos: Demonstrations, scene: Scene) -> None:
  """Checks shapes and values against the scene.

  Raises:
    FileError: A value is invalid; the message names its array and first instant.
  """
  model, n = scene.model, demos.first.size
  variants = min((len(v) for v in scene.variants.values()), default=1)
  shapes = {
    "qpos": ("f", (n, model.nq)),
    "qvel": ("f", (n, model.nv)),
    "mocap_pos": ("f", (n, model.nmocap, 3)),
    "mocap_quat": ("f", (n, model.nmocap, 4)),
    "variant": ("iu", (n,)),
    "action": ("f", (n, ACTION_DIM)),
    "first": ("b", (n,)),
  }
  for name, (kinds, shape) in shapes.items():
    array = getattr(demos, name)
    if array.dtype.kind not in kinds or array.shape != shape:
      raise FileError(f"{name} is {array.dtype}{list(array.shape)}, not {list(shape)}")
    _reject(name, "is not finite", ~np.isfinite(array))
  if not n or not demos.first[0]:
    raise FileError("the first instant must begin an episode")
  quats = [demos.qpos[:, i + 3 : i + 7] for i in model.jnt_qposadr[free_joints(model)]]
  quats += list(np.moveaxis(demos.mocap_quat, 1, 0))
  for quat in quats:
    off = abs(np.linalg.norm(quat, axis=-1) - 1) > 1e-3
    _reject("a quaternion", "is not of unit length", off)
  limited = model.jnt_limited.astype(bool)
  low, high = model.jnt_range[limited].T
  joints = demos.qpos[:, model.jnt_qposadr[limited]]
  beyond = (joints < low - _SLACK) | (joints > high + _SLACK)
  _reject("qpos", "is beyond the limit of a joint", beyond)
  unknown = ~np.isin(demos.variant, range(variants))
  _reject("variant", "is not one of the scene's", unknown)
  gripper = demos.action[:, -1]
  wrong = (abs(demos.action[:, :-1]) > 1.0).any(1) | ~np.isin(gripper, (0.0, 1.0))
  _reject("action", "is not within [-1, 1] rad/s and {0, 1}", wrong)


def _shorten(array: np.ndarray) -> str:
  return " ".join(str(array).split())[:40]


def _reject(name: str, what: str, wrong: np.ndarray) -> None:
  if wrong.any():
    instant = int(np.argwhere(wrong)[0][0])
    raise FileError(f"{name} {what} at instant {instant}")
