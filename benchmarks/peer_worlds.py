"""What the peers that step worlds in processes share: a scene, resets, the processes.

A scene travels as a file, so that a process need not import JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import multiprocessing
from multiprocessing.connection import Connection
from pathlib import Path
import time
from typing import Any, Protocol

import mujoco
import numpy as np

CONTROL_PERIOD_S = 0.15
EPISODE_STEPS = 93
RESETS = 64


@dataclasses.dataclass(frozen=True)
class World:
  """A scene and states to start from."""

  model: mujoco.MjModel
  qpos: np.ndarray  # f64[resets, nq]
  mocap_pos: np.ndarray  # f64[resets, nmocap, 3]
  mocap_quat: np.ndarray  # f64[resets, nmocap, 4]
  cameras: dict[str, tuple[int, int]]
  """Height and width of the images, by name."""

  @property
  def motors(self) -> np.ndarray:
    """i32[7]: joints of the arm, then of the driven finger."""
    return self.model.actuator_trnid[:, 0]


class Env(Protocol):
  """One world in the manner of Gymnasium."""

  def reset(self, row: int) -> None:
    """Starts from a row of the world's resets."""
    ...

  def step(self, action: np.ndarray, *, images: bool) -> dict[str, Any]:
    """One control period; the observation, with images if asked for.

    Args:
      action: f64[7], six joint velocities in rad/s, and 1 to close the gripper.
    """
    ...


def export(task_name: str, folder: Path) -> None:
  """Writes a task's scene and some of its resets; needs the project."""
  from apnpql_jax.config.schema import EnvConfig
  from apnpql_jax.tasks import make_task

  task, config = make_task(task_name), EnvConfig()
  mujoco.mj_saveModel(task.scene.model, str(folder / "model.mjb"), None)
  qpos, mocap_pos, mocap_quat, variant = map(
    np.asarray, task.sample_resets(np.random.default_rng(0), 8 * RESETS)
  )
  # The file holds one variant of the scene, so the others are left out.
  rows = np.flatnonzero(variant == 0)[:RESETS]
  np.savez(
    folder / "resets.npz",
    qpos=qpos[rows],
    mocap_pos=mocap_pos[rows],
    mocap_quat=mocap_quat[rows],
    sizes=[config.global_size, config.wrist_size],
  )


def load(folder: Path) -> World:
  """What ``export`` wrote."""
  with np.load(folder / "resets.npz") as stored:
    sizes = zip(("global", "wrist"), stored["sizes"].tolist(), strict=True)
    return World(
      model=mujoco.MjModel.from_binary_path(str(folder / "model.mjb")),
      qpos=stored["qpos"],
      mocap_pos=stored["mocap_pos"],
      mocap_quat=stored["mocap_quat"],
      cameras={name: (height, width) for name, (height, width) in sizes},
    )


def random_action(rng: np.random.Generator) -> np.ndarray:
  """f64[7]."""
  return np.append(rng.uniform(-1.0, 1.0, 6), rng.integers(2))


class Processes:
  """Worlds that run freely, one per process, as actors of a learner do."""

  def __init__(self, make: Callable[[Path], Env], folder: Path, count: int):
    """
    Args:
      make: builds a world in its process.
      folder: see ``export``.
      count: number of processes.
    """
    # Spawned: neither JAX nor a graphics library survives a fork.
    context = multiprocessing.get_context("spawn")
    self._ends: list[Connection] = []
    for seed in range(count):
      end, other = context.Pipe()
      context.Process(target=_work, args=(make, folder, other, seed)).start()
      other.close()
      self._ends.append(end)
    self._all([0.0, False])  # Until all are there.

  def measure(self, *, images: bool) -> Callable[[float], float]:
    """Control steps per second, summed over the processes."""
    return lambda seconds: sum(self._all([seconds, images]))

  def _all(self, question: Sequence[Any]) -> list[float]:
    for end in self._ends:
      end.send(question)
    answers = [end.recv() for end in self._ends]
    for answer in answers:
      if isinstance(answer, Exception):
        raise answer
    return answers


def _work(
  make: Callable[[Path], Env], folder: Path, end: Connection, seed: int
) -> None:
  rng, env, steps = np.random.default_rng(seed), make(folder), 0
  while True:
    try:
      seconds, images = end.recv()
    except EOFError:
      return
    count, began = 0, time.perf_counter()
    try:
      while (spent := time.perf_counter() - began) < seconds:
        if steps % EPISODE_STEPS == 0:
          env.reset(int(rng.integers(RESETS)))
        env.step(random_action(rng), images=images)
        steps, count = steps + 1, count + 1
      end.send(count / spent)
    except Exception as error:
      end.send(RuntimeError(f"{type(error).__name__}: {error}"))
