"""Scenes, resets and measures of the peers that step one world per process.

A scene is passed on as a file, so that a process need not import JAX.
"""

from collections.abc import Mapping
import dataclasses
import functools
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from benchmarks.peers import sides

CONTROL_PERIOD_S = 0.15
EPISODE_STEPS = 93
RESETS = 64
STATES = ("qpos", "mocap_pos", "mocap_quat")


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
    """Joints of the arm, then the driven finger, i32[7]."""
    return self.model.actuator_trnid[:, 0]


class Env(Protocol):
  """One world in the manner of Gymnasium."""

  def reset(self, row: int) -> None:
    """Starts from a row of the world's resets."""

  def step(self, action: np.ndarray, *, images: bool) -> dict[str, Any]:
    """Steps one control period and returns the observation, with images if asked for.

    ``action`` is f64[7], six joint velocities in rad/s, and 1 to close the gripper.
    """
    ...

  def look(self) -> dict[str, np.ndarray]:
    """Returns the image of each camera, u8[H, W, 3]."""
    ...


def export(task_name: str, sizes: Mapping[str, Any] | None, folder: Path) -> None:
  """Writes a task's scene and resets; ``sizes`` are those of the images, by camera."""
  from apnpql_jax.config.schema import EnvConfig
  from apnpql_jax.tasks import make_task

  task, config = make_task(task_name), EnvConfig()
  sizes = sizes or {"global": config.global_size, "wrist": config.wrist_size}
  mujoco.mj_saveModel(task.scene.model, str(folder / "model.mjb"), None)
  draw = task.sample_resets(np.random.default_rng(0), 8 * RESETS)
  # The file holds one variant of the scene, so the others are left out.
  rows = np.flatnonzero(np.asarray(draw.variant) == 0)[:RESETS]
  arrays: dict[str, Any] = {k: np.asarray(getattr(draw, k))[rows] for k in STATES}
  arrays |= {"cameras": list(sizes), "sizes": list(sizes.values())}
  np.savez(folder / "resets.npz", **arrays)


def load(folder: str | Path) -> World:
  """Reads the files of ``export``."""
  model = mujoco.MjModel.from_binary_path(str(Path(folder) / "model.mjb"))
  with np.load(Path(folder) / "resets.npz") as stored:
    states = [stored[name] for name in STATES]
    sizes = zip(stored["cameras"].tolist(), stored["sizes"].tolist(), strict=True)
    return World(model, *states, {name: (size[0], size[1]) for name, size in sizes})


def measures(env: Env, seed: int) -> dict[str, sides.Measure]:
  """Returns measures of control steps with and without images, and of images alone."""
  rng = np.random.default_rng(seed)
  steps = 0

  def step(images: bool) -> None:
    nonlocal steps
    if steps % EPISODE_STEPS == 0:
      env.reset(int(rng.integers(RESETS)))
    env.step(np.append(rng.uniform(-1.0, 1.0, 6), rng.integers(2)), images=images)
    steps += 1

  def look() -> None:
    env.reset(int(rng.integers(RESETS)))
    env.look()

  return {
    "cameras": sides.rate_of(functools.partial(step, True), 1),
    "physics": sides.rate_of(functools.partial(step, False), 1),
    "images": sides.rate_of(look, 1),
  }
