"""Settings shared by all tests."""

from __future__ import annotations

from collections.abc import Callable
import os

from hand_made import WORLDS, drawn, neutral_tool
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import runtime
from apnpql_jax.sim import physics
from apnpql_jax.sim.engines import make_physics
from apnpql_jax.sim.kinematics import Kinematics, make_kinematics
from apnpql_jax.tasks import Task, make_task
from apnpql_jax.tasks.task import ResetDraw

# Figures are written to files; no test may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
runtime.configure()


@pytest.fixture(scope="session")
def task() -> Task:
  """The shipped push_plate task. The fixtures below are of a module's own, if it
  has one, but for ``engines``."""
  return make_task("push_plate")


@pytest.fixture(scope="session")
def engines(task: Task) -> dict[str, Callable]:
  """Engine name -> jitted control period over worlds; compiled once per shape."""
  return {
    name: jax.jit(make_physics(name, task.scene, substeps=30).step)
    for name in ("native", "mjx")
  }


@pytest.fixture(scope="module")
def resets(task: Task) -> physics.PhysicsState:
  """``WORLDS`` initial states as the task draws them."""
  return drawn(task, WORLDS)


@pytest.fixture(scope="module")
def draw(task: Task) -> ResetDraw:
  """Many draws, for statistics."""
  return task.sample_resets(np.random.default_rng(0), 4000)


@pytest.fixture(scope="module")
def kinematics(task: Task, resets: physics.PhysicsState) -> Kinematics:
  """Of the initial states: the arm is high over the table."""
  return jax.jit(make_kinematics(task.scene))(resets)


@pytest.fixture(scope="module")
def neutral(task: Task) -> tuple[np.ndarray, np.ndarray]:
  """Position and rotation of the tool at the keyframe."""
  return neutral_tool(task)


@pytest.fixture(scope="module")
def rest(
  request: pytest.FixtureRequest, task: Task
) -> Callable[[physics.PhysicsState], physics.PhysicsState]:
  """1.2 s with the arm at rest and the hand open; C MuJoCo unless a test names MJX."""
  backend = getattr(request, "param", "native")
  engine = jax.jit(make_physics(backend, task.scene, substeps=240).step)

  def step(state: physics.PhysicsState) -> physics.PhysicsState:
    worlds = len(state.qpos)
    return engine(state, jnp.zeros((worlds, 6)), jnp.zeros(worlds))

  return step
