"""Demonstration files: episodes of states and actions, checked on reading.

Images, rewards and labels are computed from them; see ``docs/demonstrations.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax import runtime
from apnpql_jax.atomic import replacing
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.data import npz
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.primitives import ik
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene, free_joints
from apnpql_jax.tasks.task import Task
from apnpql_jax.types import ACTION_DIM

FORMAT = "apnpql-demonstrations"
VERSION = 1
_SLACK = 0.05  # rad; tolerance beyond a joint limit, because MuJoCo's limits are soft
_SLIDE_SLACK = 0.005  # m; the same for a slide
_KINDS = {"f": "float", "iu": "integer", "b": "bool"}
_CHUNK = 256  # instants that are judged at once


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

  def rows(self, index: np.ndarray) -> Demonstrations:
    """Returns a copy of instants, with the leading axes of ``index``."""
    return Demonstrations(*(x[index] for x in self))

  def states(self, scene: Scene) -> PhysicsState:
    """Returns the instants as states of the simulation."""
    f32 = {
      name: jnp.asarray(getattr(self, name), jnp.float32)
      for name in ("qpos", "qvel", "mocap_pos", "mocap_quat")
    }
    qvel = f32.pop("qvel")
    state = physics.initial_state(scene, **f32, variant=jnp.asarray(self.variant))
    return state.replace(qvel=qvel)


def join(*parts: Demonstrations) -> Demonstrations:
  """Returns the episodes of all parts, one after the other."""
  return Demonstrations(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def solved(demos: Demonstrations, task: Task, config: EnvConfig) -> np.ndarray:
  """Returns which episodes are solved within the time limit, bool[episodes]."""
  success, _ = _judge(demos, task, config)
  return np.logical_or.reduceat(success, np.flatnonzero(demos.first))


def until_end(demos: Demonstrations, task: Task, config: EnvConfig) -> np.ndarray:
  """Returns the instants up to each episode's success or time limit, i64[kept]."""
  success, elapsed = _judge(demos, task, config)
  earlier = np.cumsum(success) - success  # successes before each instant
  ended = earlier > earlier[np.arange(demos.instants) - elapsed]
  return np.flatnonzero(~ended & (elapsed <= config.episode_steps))


def _judge(
  demos: Demonstrations, task: Task, config: EnvConfig
) -> tuple[np.ndarray, np.ndarray]:
  """Returns where an episode is solved in time, and its control periods so far, [n]."""
  kinematics = make_kinematics(task.scene)
  success = jax.jit(lambda state: task.success(state, kinematics(state)))
  # Chunks of one size, which compile once.
  chunks = np.arange(-(-demos.instants // _CHUNK) * _CHUNK) % demos.instants
  parts = [
    success(demos.rows(rows).states(task.scene)) for rows in chunks.reshape(-1, _CHUNK)
  ]
  success_now = np.concatenate(parts)[: demos.instants]
  begin = np.flatnonzero(demos.first)
  elapsed = np.arange(demos.instants) - begin[np.cumsum(demos.first) - 1]
  # An episode cannot end at its first instant.
  return success_now & (elapsed > 0) & (elapsed <= config.episode_steps), elapsed


def only_solved(demos: Demonstrations, task: Task, config: EnvConfig) -> Demonstrations:
  """Returns the solved episodes.

  Raises:
    FileError: No episode is solved.
  """
  kept = solved(demos, task, config)
  if not kept.any():
    raise FileError(f"none of the {len(kept)} episodes is solved")
  return demos.rows(np.flatnonzero(kept[np.cumsum(demos.first) - 1]))


def solve_targets(demos: Demonstrations, rows: np.ndarray, task: Task) -> np.ndarray:
  """Returns the joint targets (rad) of the primitives, f32[len(rows), 3, 6].

  Raises:
    FileError: The arm cannot reach a target.
  """
  unique, inverse = np.unique(rows, return_inverse=True)
  state = demos.rows(unique).states(task.scene)
  kinematics = make_kinematics(task.scene)(state)
  positions, rotations, _ = map(np.asarray, task.tool_targets(state, kinematics))
  starts = np.asarray(state.qpos[:, task.scene.arm_qpos])
  targets, residuals = ik.solve_all(starts, positions, rotations)
  far = (residuals > [ik.POSITION_TOLERANCE, ik.ROTATION_TOLERANCE]).any((1, 2))
  if far.any():
    raise FileError(
      f"demonstrations: the arm cannot reach a primitive's target at instant "
      f"{unique[far.argmax()]}"
    )
  return targets.astype(np.float32)[inverse]


def is_demonstrations(path: Path) -> bool:
  """Checks whether a file claims to hold demonstrations."""
  return "format" in npz.names(path)


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


def load(
  path: Path, task: Task, config: EnvConfig, *, allow_unsolved: bool = False
) -> Demonstrations:
  """Reads and checks a demonstration file.

  Raises:
    FileError: The file has another format, version, task or control period, or an
      invalid state, or no episode is solved and ``allow_unsolved`` is False.
  """
  arrays = npz.read(path, limit=runtime.host_memory() or 1 << 32)
  fields = Demonstrations._fields
  wanted = {"format", "version", "task", "control_period_s", *fields}
  expected = {"format": FORMAT, "version": VERSION, "task": task.name}
  for name, value in expected.items():
    if name in arrays and str(arrays[name]) != str(value):
      raise FileError(f"{path} has {name} {_shorten(arrays[name])}, not {value}")
  try:
    npz.check_names(arrays.keys(), wanted)
    period, period_s = arrays["control_period_s"], config.control_period_s
    if period.shape or period.dtype.kind != "f" or abs(period - period_s) > 1e-6:
      raise FileError(f"control_period_s is {_shorten(period)}, not {period_s}")
    demos = Demonstrations(**{name: arrays[name] for name in fields})
    check(demos, task.scene)
    if not allow_unsolved:
      check_solved(demos, task, config, flag="--replay.allow-unsolved")
  except UserError as error:
    raise FileError(f"{path}: {error}") from None
  return demos


def check_reachable(demos: Demonstrations, task: Task) -> None:
  """Raises ``FileError`` if the arm cannot follow a primitive from an episode's start.

  Training refuses such demonstrations.
  """
  solve_targets(demos, np.flatnonzero(demos.first), task)


def check_solved(
  demos: Demonstrations, task: Task, config: EnvConfig, *, flag: str
) -> None:
  """Raises ``FileError`` if no episode is solved; it names the ``flag`` to allow it."""
  if not solved(demos, task, config).any():
    raise FileError(
      f"none of the {demos.first.sum()} episodes is solved: check units, frame and the "
      f"order of quaternions (w x y z), or allow it with {flag}"
    )


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
      expected = f"{_KINDS[kinds]}{list(shape)}"
      raise FileError(f"{name} is {array.dtype}{list(array.shape)}, not {expected}")
    _reject(name, "is not finite", ~np.isfinite(array))
  if not n or not demos.first[0]:
    raise FileError("the first instant must begin an episode")
  if demos.first.all():
    raise FileError("first begins an episode at every instant, so no action leads on")
  quats = [demos.qpos[:, i + 3 : i + 7] for i in model.jnt_qposadr[free_joints(model)]]
  quats += list(np.moveaxis(demos.mocap_quat, 1, 0))
  for quat in quats:
    off = abs(np.linalg.norm(quat, axis=-1) - 1) > 1e-3
    _reject("a quaternion", "is not of unit length", off)
  limited = model.jnt_limited.astype(bool)
  low, high = model.jnt_range[limited].T
  joints = demos.qpos[:, model.jnt_qposadr[limited]]
  slides = model.jnt_type[limited] == mujoco.mjtJoint.mjJNT_SLIDE
  slack = np.where(slides, _SLIDE_SLACK, _SLACK)
  beyond = (joints < low - slack) | (joints > high + slack)
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
