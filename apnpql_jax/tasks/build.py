"""Building of tasks by name, with a check that they follow the protocol ``Task``.

A method that returns a wrong shape would fail deep in a compiled program, or silently
drive the wrong joint.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import inspect
from typing import Any

import jax
import numpy as np

from apnpql_jax.errors import ConfigError, UserError, one_line
from apnpql_jax.sim import physics, scene_checks
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.sim.scene import Scene, free_joints
from apnpql_jax.tasks.task import ResetDraw, Task, task_class
from apnpql_jax.types import ACTION_DIM, NUM_PRIMITIVES

_WORLDS = 5  # number of worlds in the checks; no other axis has this length


def make_task(name: str) -> Task:
  """Builds the task ``name`` and checks it.

  Raises:
    ConfigError: No task has this name, two files want it, its class is not in a file, a
      free body of its scene would fall out of the world, or a method does not follow
      the protocol.
  """
  kind = task_class(name)
  _check_file(name, kind)
  task = _call(name, "__init__", kind)
  scene = getattr(task, "scene", None)
  if not isinstance(scene, Scene):
    raise ConfigError(f"task {name!r} has no Scene in its attribute scene")
  scene_checks.check_support(scene.model, scene.name)
  state, kinematics = _check_resets(task)
  n, k = _WORLDS, NUM_PRIMITIVES
  primitives = _floats(n, k, ACTION_DIM)
  targets = _floats(n, k, 3), _floats(n, k, 3, 3), _floats(n, k)
  _check(task, "tool_targets", (state, kinematics), targets)
  _check(task, "success", (state, kinematics), jax.ShapeDtypeStruct((n,), bool))
  _check(task, "expert", (state, kinematics, primitives), _floats(n, ACTION_DIM))
  _check(task, "objects", (state,), None)
  return task


def _check_file(name: str, kind: type[Task]) -> None:
  """Checks that a class is in a file, next to which its scene may be."""
  try:
    inspect.getfile(kind)
  except (OSError, TypeError):
    raise ConfigError(
      f"the class of task {name!r} is not in a file, but in a notebook or at a prompt; "
      "save it in a Python file, and pass the path of that file to load_preset"
    ) from None


def _check_resets(task: Task) -> tuple[PhysicsState, Kinematics]:
  """Checks drawn resets; returns the shapes of their states and poses."""
  scene, model, n = task.scene, task.scene.model, _WORLDS
  rng = np.random.default_rng(0)
  draw = _call(task.name, "sample_resets", _method(task, "sample_resets"), rng, n)
  if not isinstance(draw, ResetDraw):
    returned = type(draw).__name__
    raise ConfigError(
      f"task {task.name!r}: sample_resets returns {returned}, not ResetDraw"
    )
  mocap = _floats(n, model.nmocap, 3), _floats(n, model.nmocap, 4)
  variants = jax.ShapeDtypeStruct((n,), np.int32)
  _compare(task, "sample_resets", draw, (_floats(n, model.nq), *mocap, variants))
  quats = [draw.qpos[:, i + 3 : i + 7] for i in model.jnt_qposadr[free_joints(model)]]
  quats += list(np.moveaxis(draw.mocap_quat, 1, 0))
  lengths = [np.linalg.norm(quat, axis=-1) for quat in quats]
  count = min((len(v) for v in scene.variants.values()), default=1)
  faults = {
    "a value that is not finite": not all(np.isfinite(x).all() for x in draw),
    "a quaternion that is not of unit length": any(
      (abs(length - 1) > 1e-3).any() for length in lengths
    ),
    f"a variant that is not from 0 to {count - 1}": (
      not np.isin(draw.variant, range(count)).all()
    ),
  }
  for fault, found in faults.items():
    if found:
      raise ConfigError(f"task {task.name!r}: sample_resets returns {fault}")
  start = functools.partial(physics.initial_state, scene)
  state = jax.eval_shape(start, _floats(n, model.nq), *mocap, variants)
  poses: dict[str, Any] = {}
  for kind, size in ("geom", model.ngeom), ("site", model.nsite), ("cam", model.ncam):
    poses[f"{kind}_xpos"] = _floats(n, size, 3)
    poses[f"{kind}_xmat"] = _floats(n, size, 3, 3)
  return state, Kinematics(**poses, fields=state.fields)


def _check(task: Task, method: str, inputs: tuple[Any, ...], expected: Any) -> None:
  """Checks the shapes that a method returns; None stands for points [worlds, 3 k]."""
  found = _call(task.name, method, jax.eval_shape, _method(task, method), *inputs)
  if expected is None:
    size = (*getattr(found, "shape", ()), 0, 0)[1]
    expected = _floats(_WORLDS, max(size // 3, 1) * 3)
  _compare(task, method, found, expected)


def _compare(task: Task, method: str, found: Any, expected: Any) -> None:
  returned, wanted = _describe(found), _describe(expected)
  if returned != wanted:
    raise ConfigError(
      f"task {task.name!r}: {method} returns {returned} for {_WORLDS} worlds, not "
      f"{wanted}"
    )


def _method(task: Task, name: str) -> Callable[..., Any]:
  method = getattr(task, name, None)
  if not callable(method):
    raise ConfigError(f"task {task.name!r} has no method {name}")
  return method


def _call(task: str, method: str, function: Callable[..., Any], *inputs: Any) -> Any:
  """Calls a function of a task; whatever it raises becomes a ``ConfigError``."""
  try:
    return function(*inputs)
  except UserError:
    raise
  except Exception as error:
    reason = f"{type(error).__name__}: {one_line(error)}"
    raise ConfigError(f"task {task!r}: {method} fails with {reason}") from error


def _describe(value: Any) -> str:
  """Returns kinds and shapes of arrays, such as ``float[5, 7]``."""
  if isinstance(value, tuple | list):
    return f"({', '.join(map(_describe, value))})"
  if not (hasattr(value, "shape") and hasattr(value, "dtype")):
    return type(value).__name__
  kinds = {"f": "float", "i": "int", "u": "int", "b": "bool"}
  kind = kinds.get(getattr(value.dtype, "kind", ""), str(value.dtype))
  return f"{kind}{list(value.shape)}"


def _floats(*shape: int) -> jax.ShapeDtypeStruct:
  return jax.ShapeDtypeStruct(shape, np.float32)
