"""Demonstration files: episodes of states and actions, checked before they are used.

A file holds what cannot be computed, the states of the scene and the actions; images,
rewards and labels are made from them as those of any world are. The format is in
``docs/demonstrations.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from apnpql_jax import devices
from apnpql_jax.data import npz
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.sim.scene import Scene, free_joints
from apnpql_jax.tasks.task import Task
from apnpql_jax.types import ACTION_DIM

FORMAT = "apnpql-demonstrations"
VERSION = 1

_SLACK = 0.05
"""rad; how far a joint may be beyond its limit, which MuJoCo keeps softly."""


class Demonstrations(NamedTuple):
  """Instants of episodes, one episode after the other, one control period apart."""

  qpos: np.ndarray  # f32[n, nq]
  qvel: np.ndarray  # f32[n, nv]
  mocap_pos: np.ndarray  # f32[n, nmocap, 3], m
  mocap_quat: np.ndarray  # f32[n, nmocap, 4]
  variant: np.ndarray  # i32[n]: of the scene
  action: np.ndarray  # f32[n, 7]; that of an episode's last instant is ignored
  first: np.ndarray  # bool[n]: an episode begins here

  @property
  def instants(self) -> int:
    """How many there are."""
    return len(self.first)


def save(
  path: Path, demos: Demonstrations, *, task: str, control_period_s: float
) -> dict[str, Any]:
  """Writes a demonstration file; returns its name and what it holds.

  Raises:
    FileError: it cannot be written.
  """
  arrays: dict[str, Any] = {
    "format": FORMAT,
    "version": VERSION,
    "task": task,
    "control_period_s": control_period_s,
    **demos._asdict(),
  }
  try:
    with path.open("wb") as file:  # Given a name, NumPy would append to it.
      np.savez_compressed(file, **arrays)
  except OSError as error:
    raise FileError(f"cannot write {path}: {error}") from None
  episodes = int(demos.first.sum())
  return {"file": str(path), "instants": demos.instants, "demonstrations": episodes}


def load(path: Path, task: Task, control_period_s: float) -> Demonstrations:
  """Reads and checks a demonstration file.

  Raises:
    FileError: it is no such file, of another version, task or control period, or
      holds what the scene cannot be in; the message names it.
  """
  arrays = npz.read(path, limit=devices.host_memory() or 1 << 32)
  fields = Demonstrations._fields
  wanted = {"format", "version", "task", "control_period_s", *fields}
  if arrays.keys() != wanted:
    names = ", ".join(sorted(arrays.keys() ^ wanted))
    raise FileError(f"{path} lacks or has in excess: {names}")
  expected = (FORMAT, VERSION, task.name, control_period_s)
  for name, value in zip(("format", "version", "task"), expected, strict=False):
    if str(arrays[name]) != str(value):
      raise FileError(f"{path} has {name} {_shown(arrays[name])}, not {value}")
  period = arrays["control_period_s"]
  if period.shape or period.dtype.kind != "f" or abs(period - expected[3]) > 1e-6:
    raise FileError(f"{path} has control_period_s {_shown(period)}, not {expected[3]}")
  try:
    demos = Demonstrations(**{name: arrays[name] for name in fields})
    check(demos, task.scene)
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  return demos


def check(demos: Demonstrations, scene: Scene) -> None:
  """Refuses what the scene cannot be in.

  Raises:
    FileError: names the array and the first instant that is wrong.
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
    _refuse(name, "is not finite", ~np.isfinite(array))
  if not n or not demos.first[0]:
    raise FileError("the first instant must begin an episode")
  addresses = model.jnt_qposadr[free_joints(model)]
  quats = [demos.qpos[:, i + 3 : i + 7] for i in addresses]
  quats += list(np.moveaxis(demos.mocap_quat, 1, 0))
  for quat in quats:
    off = abs(np.linalg.norm(quat, axis=-1) - 1) > 1e-3
    _refuse("a quaternion", "is not of unit length", off)
  limited = model.jnt_limited.astype(bool)
  low, high = model.jnt_range[limited].T
  joints = demos.qpos[:, model.jnt_qposadr[limited]]
  beyond = (joints < low - _SLACK) | (joints > high + _SLACK)
  _refuse("qpos", "is beyond the limit of a joint", beyond)
  _refuse("variant", "is none of the scene's", ~np.isin(demos.variant, range(variants)))
  gripper = demos.action[:, -1]
  wrong = (abs(demos.action[:, :-1]) > 1.0).any(1) | ~np.isin(gripper, (0.0, 1.0))
  _refuse("action", "is not within [-1, 1] rad/s and {0, 1}", wrong)


def _shown(array: np.ndarray) -> str:
  return " ".join(str(array).split())[:40]


def _refuse(name: str, what: str, wrong: np.ndarray) -> None:
  if wrong.any():
    instant = int(np.argwhere(wrong)[0][0])
    raise FileError(f"{name} {what} at instant {instant}")
