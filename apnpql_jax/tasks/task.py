"""The interface of a task: scene, resets, success, tool targets, scripted expert.

A task is a Python file, an MJCF file and a preset: in this package, in a folder of the
user, or in an installed package whose entry points in the group ``apnpql.tasks`` name
the module that registers it. Everything is batched over worlds on the first axis;
positions are in m in the world frame.
"""

from __future__ import annotations

import functools
import importlib
from importlib import metadata
import inspect
import logging
import pkgutil
from typing import NamedTuple, Protocol, TypeVar

from jaxtyping import Bool, Float, Int
import numpy as np

from apnpql_jax.config import user_files
from apnpql_jax.errors import ConfigError, check_name, one_line
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import Array


class ResetDraw(NamedTuple):
  """Initial states as a task draws them, before they settle."""

  qpos: Float[np.ndarray, "n nq"]
  mocap_pos: Float[np.ndarray, "n nmocap 3"]  # m
  mocap_quat: Float[np.ndarray, "n nmocap 4"]
  variant: Int[np.ndarray, " n"]  # of the scene


# Positions (m), rotations and gripper commands (1 closes) for object, goal, neutral.
ToolTargets = tuple[
  Float[Array, "worlds 3 3"], Float[Array, "worlds 3 3 3"], Float[Array, "worlds 3"]
]


class Task(Protocol):
  """The protocol of the paper's four tasks (Sec. V-A) and of any other."""

  name: str
  scene: Scene

  def sample_resets(self, rng: np.random.Generator, count: int) -> ResetDraw:
    """Draws initial states uniformly within the task's ranges, without overlaps."""

  def tool_targets(self, state: PhysicsState, kinematics: Kinematics) -> ToolTargets:
    """Returns where each action primitive leads the tool from the present state."""

  def success(
    self, state: PhysicsState, kinematics: Kinematics
  ) -> Bool[Array, " worlds"]:
    """Checks whether the task is solved, which is rewarded once with +1."""

  def objects(self, state: PhysicsState) -> Float[Array, "worlds 3*k"]:
    """Returns k points (m) that give the poses of objects and goals, for --obs state.

    A direction is given by the point ``geometry.POINTER`` away along it.
    """

  def expert(
    self,
    state: PhysicsState,
    kinematics: Kinematics,
    primitives: Float[Array, "worlds 3 7"],
  ) -> Float[Array, "worlds 7"]:
    """Returns the scripted expert's actions, given those that follow the primitives."""


class _NameTaken(ConfigError):
  """The error that another class has the name."""

  def __init__(self, message: str, name: str):
    super().__init__(message)
    self.name = name


T = TypeVar("T", bound=Task)
_REGISTRY: dict[str, type[Task]] = {}
_CLASHES: dict[str, str] = {}
"""Name -> message, for names that two files of this package want."""

_LEFT_OUT: set[str] = set()
"""Modules that cannot be imported."""


def register_task(task: type[T]) -> type[T]:
  """Registers a task class under its ``name``, as a decorator.

  Raises ``ConfigError`` if another class has this name; a reloaded one replaces itself.
  """
  holder = _REGISTRY.setdefault(task.name, task)
  if (holder.__module__, holder.__qualname__) != (task.__module__, task.__qualname__):
    raise _NameTaken(
      f"task name {task.name!r} of {_origin(task)} is taken by {_origin(holder)}; "
      "choose another name",
      task.name,
    )
  _REGISTRY[task.name] = task
  return task


def task_names() -> list[str]:
  """Returns the names of all tasks, sorted; imports the modules that register them.

  Logs one line for a module that cannot be imported, and leaves its task out.
  """
  package = importlib.import_module("apnpql_jax.tasks")
  own = pkgutil.iter_modules(package.__path__, f"{package.__name__}.")
  for name in (*(found.name for found in own), *_installed()):
    if name in _LEFT_OUT:
      continue
    try:
      importlib.import_module(name)
    except Exception as error:  # Whatever is wrong with a file of the user.
      _LEFT_OUT.add(name)
      if isinstance(error, _NameTaken):
        _CLASHES[error.name] = str(error)
      reason = f"{type(error).__name__}: {one_line(error)}"
      logging.getLogger(__name__).warning("%s is left out: %s", name, reason)
  return sorted(_REGISTRY)


def registered_by(module: str) -> list[str]:
  """Returns the names of the tasks whose classes are in a module, sorted."""
  return sorted(n for n, task in _REGISTRY.items() if task.__module__ == module)


def task_class(name: str) -> type[Task]:
  """Returns the class of the task ``name``.

  Raises:
    ConfigError: No task has this name, or two files want it.
  """
  check_name("task", name, task_names())
  if name in _CLASHES:
    raise ConfigError(_CLASHES[name])
  return _REGISTRY[name]


@functools.cache
def _installed() -> list[str]:
  """Returns the modules of other installed packages that register tasks."""
  return [point.module for point in metadata.entry_points(group="apnpql.tasks")]


def _origin(task: type[Task]) -> str:
  """Returns the module and name of a class, or its file if that is the user's."""
  if user_files.is_loaded(task.__module__):
    return inspect.getfile(task)
  return f"{task.__module__}.{task.__qualname__}"
