"""What a task is: a scene, resets, success, tool targets and a scripted expert.

A task is one Python file, one MJCF file and one preset. Everything here is
batched over worlds on the first axis; positions are in m in the world frame.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib
import pkgutil
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from apnpql_jax.errors import check_name
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array


class ResetDraw(NamedTuple):
  """Initial states as a task draws them, before they are settled."""

  qpos: np.ndarray  # f64[n, nq]
  mocap_pos: np.ndarray  # f64[n, nmocap, 3], m
  mocap_quat: np.ndarray  # f64[n, nmocap, 4]
  variant: np.ndarray  # i64[n]: of the scene


class Task(Protocol):
  """The four tasks of the paper (Sec. V-A) and any other are this."""

  name: str
  scene: Scene

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """Draws initial states uniformly within the task's ranges, without overlaps."""
    ...

  def tool_targets(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> tuple[Array, Array, Array]:
    """Where each action primitive wants the tool now, and what of the gripper.

    Returns:
      positions f32[worlds, 3, 3] (m), rotations f32[worlds, 3, 3, 3] and gripper
      commands f32[worlds, 3] (1 closes); rows are target object, desired goal and
      neutral configuration.
    """
    ...

  def success(self, state: PhysicsState, kinematics: Kinematics) -> Array:
    """bool[worlds]: the task is solved; rewarded once with +1."""
    ...

  def objects(self, state: PhysicsState) -> Array:
    """f32[worlds, 3 k]: k points (m) that tell the poses of objects and goals, for
    --obs state. A direction is the point ``geometry.POINTER`` away in it."""
    ...

  def expert(
    self, state: PhysicsState, kinematics: Kinematics, primitives: Array
  ) -> Array:
    """f32[worlds, 7]: the scripted policy, a feedback on the privileged state.

    Args:
      state: [worlds, ...].
      kinematics: [worlds, ...].
      primitives: f32[worlds, 3, 7], the actions that follow each primitive.
    """
    ...


_REGISTRY: dict[str, Callable[[], Task]] = {}
T = TypeVar("T", bound=Task)


def register_task(task: type[T]) -> type[T]:
  """Class decorator that makes a task known under its ``name``."""
  _REGISTRY[task.name] = task
  return task


def task_names() -> list[str]:
  """Names of all registered tasks, sorted."""
  _import_all()
  return sorted(_REGISTRY)


def make_task(name: str) -> Task:
  """Builds the task ``name``.

  Raises:
    ConfigError: unknown name; the message lists the valid ones.
  """
  check_name("task", name, task_names())
  return _REGISTRY[name]()


def _import_all() -> None:
  package = importlib.import_module("apnpql_jax.tasks")
  for module in pkgutil.iter_modules(package.__path__):
    importlib.import_module(f"apnpql_jax.tasks.{module.name}")
