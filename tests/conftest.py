"""Settings shared by all tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path

from hand_made import WORLDS, drawn, neutral_tool
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import runtime, testing
from apnpql_jax.sim import physics
from apnpql_jax.sim.engines import make_physics
from apnpql_jax.sim.kinematics import Kinematics, make_kinematics
from apnpql_jax.tasks import Task, make_task
from apnpql_jax.tasks.task import ResetDraw

# Figures are written to files; no test may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
# Compilation takes most of the time of the tests, so it does not optimize. Results
# then differ in their last bits, so the tests keep their reset banks to themselves.
os.environ["XDG_CACHE_HOME"] = str(testing.ROOT / ".pytest_cache" / "home")
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {testing.XLA_FLAGS}"
runtime.configure()


FIRST = "test_resume test_sharding test_train test_library test_toy_learning".split()
"""Files whose tests take long, lest one worker ends long after the others."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
  """Runs the files of ``FIRST`` first."""
  items.sort(key=lambda item: item.path.stem not in FIRST)


def pytest_collection_finish() -> None:
  """Keeps the garbage collector from slowing down the compilations."""
  runtime.collect_garbage_less_often()


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
  """Frees compiled programs before Linux's 65,530 memory maps of a process run out.

  A program takes hundreds of them; the one that finds none left crashes the process.
  """
  yield
  maps = Path("/proc/self/maps")
  if maps.exists() and len(maps.read_text().splitlines()) > 20_000:
    jax.clear_caches()


@pytest.fixture(scope="session")
def task() -> Task:
  """Returns the push_plate task.

  A module may override it; the fixtures below, except ``engines``, then use its task.
  """
  return make_task("push_plate")


@pytest.fixture(scope="session")
def engines(task: Task) -> dict[str, Callable]:
  """Returns engine name -> jitted control period over worlds."""
  return {
    name: jax.jit(make_physics(name, task.scene, substeps=30).step)
    for name in ("native", "mjx")
  }


@pytest.fixture(scope="module")
def resets(task: Task) -> physics.PhysicsState:
  """Returns ``WORLDS`` initial states drawn by the task."""
  return drawn(task, WORLDS)


@pytest.fixture(scope="module")
def draw(task: Task) -> ResetDraw:
  """Returns many draws, for statistics."""
  return task.sample_resets(np.random.default_rng(0), 4000)


@pytest.fixture(scope="module")
def kinematics(task: Task, resets: physics.PhysicsState) -> Kinematics:
  """Returns the kinematics of the initial states, with the arm high over the table."""
  return make_kinematics(task.scene)(resets)


@pytest.fixture(scope="module")
def neutral(task: Task) -> tuple[np.ndarray, np.ndarray]:
  """Returns position and rotation of the tool at the keyframe."""
  return neutral_tool(task)


@pytest.fixture(scope="module")
def rest(
  request: pytest.FixtureRequest, task: Task
) -> Callable[[physics.PhysicsState], physics.PhysicsState]:
  """Returns a step of 1.2 s with the arm still and the hand open, on C MuJoCo.

  Tests can request another engine by indirect parametrization.
  """
  backend = getattr(request, "param", "native")
  engine = jax.jit(make_physics(backend, task.scene, substeps=240).step)

  def step(state: physics.PhysicsState) -> physics.PhysicsState:
    worlds = len(state.qpos)
    return engine(state, jnp.zeros((worlds, 6)), jnp.zeros(worlds))

  return step
