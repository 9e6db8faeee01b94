"""Demonstration files: episodes of states and actions, checked before they are used.

A file holds what cannot be computed, the states of the scene and the actions; images,
rewards and labels are made from them as those of any world are. The format is in
``docs/demonstrations.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax import memory, npz, replay
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.env import Env, make_env
from apnpql_jax.env_state import EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.iteration import example_slot, place
from apnpql_jax.primitives import ik
from apnpql_jax.replay import Replay
from apnpql_jax.rollout import expert_policy
from apnpql_jax.sim import physics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import ACTION_DIM, Array, Slot

FORMAT = "apnpql-demonstrations"
VERSION = 1

_SLACK = 0.05
"""rad; how far a joint may be beyond its limit, which MuJoCo keeps softly."""


CERTAIN = 100.0
"""nats; log density of actions whose policy is not known: so high that Retrace does not
correct for it but cuts the trace."""


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
    ConfigError: it cannot be written.
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
    raise ConfigError(f"cannot write {path}: {error}") from None
  episodes = int(demos.first.sum())
  return {"file": str(path), "instants": demos.instants, "demonstrations": episodes}


def load(path: Path, env: Env) -> Demonstrations:
  """Reads and checks a demonstration file.

  Raises:
    ConfigError: it is no such file, of another version, task or control period, or
      holds what the scene cannot be in; the message names it.
  """
  arrays = npz.read(path, limit=memory.host_memory() or 1 << 32)
  fields = Demonstrations._fields
  wanted = {"format", "version", "task", "control_period_s", *fields}
  if arrays.keys() != wanted:
    names = ", ".join(sorted(arrays.keys() ^ wanted))
    raise ConfigError(f"{path} lacks or has in excess: {names}")
  expected = (FORMAT, VERSION, env.task.name, env.config.control_period_s)
  for name, value in zip(("format", "version", "task"), expected, strict=False):
    if str(arrays[name]) != str(value):
      raise ConfigError(f"{path} has {name} {_shown(arrays[name])}, not {value}")
  period = arrays["control_period_s"]
  if period.shape or period.dtype.kind != "f" or abs(period - expected[3]) > 1e-6:
    raise ConfigError(
      f"{path} has control_period_s {_shown(period)}, not {expected[3]}"
    )
  try:
    demos = Demonstrations(**{name: arrays[name] for name in fields})
    check(demos, env.task.scene)
  except ConfigError as error:
    raise ConfigError(f"{path}: {error}") from None
  return demos


def check(demos: Demonstrations, scene: Scene) -> None:
  """Refuses what the scene cannot be in.

  Raises:
    ConfigError: names the array and the first instant that is wrong.
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
      raise ConfigError(
        f"{name} is {array.dtype}{list(array.shape)}, not {list(shape)}"
      )
    _refuse(name, "is not finite", ~np.isfinite(array))
  if not n or not demos.first[0]:
    raise ConfigError("the first instant must begin an episode")
  quats = [demos.qpos[:, i + 3 : i + 7] for i in _free_joints(model)]
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


def make_replay(demos: Demonstrations, config: TrainConfig, env: Env) -> Replay:
  """The expert's replay of ``replay.expert_steps`` slots, made from demonstrations.

  Each column of the ring holds a stretch of them, one after the other; they are
  repeated if there are not enough, and those too many are left out.
  """
  worlds = config.env.worlds
  length = config.replay.expert_steps // worlds
  n = demos.instants
  index = np.resize(np.arange(n), (worlds, length)).T
  fresh = demos.first[index]
  fresh[0] = True  # A column may begin in the middle of an episode.
  ends = np.append(demos.first[1:], True)[index]
  targets = np.zeros((length, worlds, 3, 6), np.float32)
  targets[fresh] = _solve_targets(demos, index[fresh], env)

  @jax.jit
  def remake(
    start: EnvState, index: Array, fresh: Array, targets: Array, ends: Array
  ) -> Replay:
    def instant(before: EnvState, seen: tuple) -> tuple[EnvState, Slot]:
      rows, fresh, targets, ends = seen
      now = _states(demos, env.task.scene, rows)
      state = env.arrive(env.after(before, now, targets, fresh))
      timestep = state.timestep
      timestep = timestep.replace(
        truncated=timestep.truncated | ends & ~timestep.terminated
      )
      action = jnp.asarray(demos.action, jnp.float32)[rows]
      return state, Slot(timestep, action, jnp.full(worlds, CERTAIN, jnp.float32))

    _, chunk = jax.lax.scan(instant, start, (index, fresh, targets, ends))
    ring = replay.add(replay.create(example_slot(start), length, worlds), chunk)
    return place(ring, env.mesh)

  start = env.reset(jnp.zeros(worlds, jnp.int32))
  return remake(start, *map(jnp.asarray, (index, fresh, targets, ends)))


def save_expert(path: Path, config: EnvConfig, **settings: Any) -> dict[str, Any]:
  """``record_expert`` into a file."""
  demos = record_expert(make_env(config), **settings)
  period_s = config.control_period_s
  return save(path, demos, task=config.task, control_period_s=period_s)


def record_expert(
  env: Env, *, episodes: int, seed: int, noise: float
) -> Demonstrations:
  """Episodes of the task's scripted expert, up to success or time-out.

  They begin at rows of the bank that training sees. Those in which the world was not
  finite are left out.
  """
  policy = expert_policy(env, noise=noise)
  row_key, key = jax.random.split(jax.random.key(seed))
  rows = jax.random.randint(row_key, (episodes,), 0, env.bank_split)

  @jax.jit
  def play(start: EnvState, key: Array):
    def period(state: EnvState, key: Array):
      policy_key, env_key = jax.random.split(key)
      action, _ = policy(state, policy_key)
      after = env.step(state, action, env_key)
      return after, (state.physics, action, state.timestep.last, state.faults)

    keys = jax.random.split(key, env.config.episode_steps + 1)
    return jax.lax.scan(period, start, keys)[1]

  played = play(env.reset(rows), key)
  state, action, last, faults = jax.tree.map(np.asarray, played)
  end = last.argmax(0)  # The first last instant; all sound episodes end in time.
  sound = last.any(0) & (faults[end, np.arange(episodes)] == 0)
  inside = (np.arange(len(last))[:, None] <= np.where(sound, end, -1)).T
  take = lambda x: np.moveaxis(x, 1, 0)[inside]  # noqa: E731 - a name for one index
  first = np.zeros_like(inside)
  first[:, 0] = True
  variant = np.asarray(env.variant(rows))[:, None].repeat(len(last), 1)
  return Demonstrations(
    *(take(x) for x in (state.qpos, state.qvel, state.mocap_pos, state.mocap_quat)),
    variant[inside],
    take(action),
    first[inside],
  )


def _states(demos: Demonstrations, scene: Scene, rows: Array) -> PhysicsState:
  f32 = {
    name: jnp.asarray(getattr(demos, name), jnp.float32)[rows]
    for name in ("qpos", "qvel", "mocap_pos", "mocap_quat")
  }
  qvel = f32.pop("qvel")
  state = physics.initial_state(scene, **f32, variant=jnp.asarray(demos.variant)[rows])
  return state.replace(qvel=qvel)


def _solve_targets(demos: Demonstrations, rows: np.ndarray, env: Env) -> np.ndarray:
  """f32[len(rows), 3, 6], where the primitives lead when an episode begins."""
  unique, inverse = np.unique(rows, return_inverse=True)
  state = _states(demos, env.task.scene, jnp.asarray(unique))
  positions, rotations, _ = map(np.asarray, env.tool_targets(state))
  starts = np.asarray(state.qpos[:, env.task.scene.arm_qpos])
  targets, residuals = ik.solve_all(starts, positions, rotations)
  far = (residuals > [ik.POSITION_TOLERANCE, ik.ROTATION_TOLERANCE]).any((1, 2))
  if far.any():
    raise ConfigError(
      f"demonstrations: the arm cannot reach a primitive's target at instant "
      f"{unique[far.argmax()]}"
    )
  return targets.astype(np.float32)[inverse]


def _free_joints(model: mujoco.MjModel) -> np.ndarray:
  return model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]


def _shown(array: np.ndarray) -> str:
  return " ".join(str(array).split())[:40]


def _refuse(name: str, what: str, wrong: np.ndarray) -> None:
  if wrong.any():
    instant = int(np.argwhere(wrong)[0][0])
    raise ConfigError(f"{name} {what} at instant {instant}")
