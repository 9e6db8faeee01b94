"""Transfer: the loop over time, OpenGL against the ray caster, unseen looks."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.sim.graphics import area_resized
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import Task
from apnpql_jax.training.rollout import expert_policy, make_player
from apnpql_jax.training.train import train
from apnpql_jax.transfer import looks
from apnpql_jax.transfer.opengl import OpenGL
from apnpql_jax.transfer.play import play
from apnpql_jax.transfer.transfer import Cell, make_draw, transfer, transfer_expert

CONFIG = dataclasses.replace(testing.TINY.env, task="push_plate")

FROZEN = (2, 4, [5, 1, 1, 3])
"""Table, number of things and surfaces of the unseen look at row 7."""


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def plain(env: Env) -> Iterator[OpenGL]:
  yield from opened(env.task, unseen=False)


@pytest.fixture(scope="module")
def strange(env: Env) -> Iterator[OpenGL]:
  yield from opened(env.task, unseen=True)


def opened(task: Task, *, unseen: bool) -> Iterator[OpenGL]:
  try:
    gl = OpenGL(task.scene, CONFIG, unseen=unseen)
  except ConfigError as error:
    if "needs EGL or OSMesa" not in str(error):
      raise
    pytest.skip("no graphics library is installed")
  with gl:
    yield gl


ROWS = np.arange(3)


@pytest.fixture(scope="module")
def state(env: Env) -> EnvState:
  """Returns the worlds at ``ROWS`` of the bank."""
  return env.reset(jnp.asarray(ROWS))


def images(gl: OpenGL, env: Env, state: EnvState, time: int = 0) -> list[np.ndarray]:
  """Returns the images of the worlds."""
  views = make_draw(env, gl)(state, ROWS, np.ones(len(ROWS), bool), time)
  return [np.asarray(view) for view in views]


def test_the_loop_plays_the_episodes_of_the_player(env):
  rows, key = jnp.asarray(ROWS), jax.random.key(3)
  noisy = expert_policy(env, noise=0.05)
  expected = make_player(env, lambda _: noisy)(None, rows, key)
  act = jax.jit(lambda state, key: noisy(state, key)[0])
  found = play(env, lambda state, seen, key: act(state, key), rows, key)
  np.testing.assert_array_equal(found.success, expected.success)
  np.testing.assert_array_equal(found.length, expected.length)
  assert [len(x) for x in found.stages] == found.length.tolist()
  assert found.success.any()


@pytest.mark.parametrize("randomize", [False, True])
def test_opengl_sees_what_the_ray_caster_sees(randomize, plain, env, state):
  scene, physics = env.task.scene, state.physics
  if randomize:
    # OpenGL draws no checkers and no waves.
    ranges = dataclasses.replace(CONFIG.randomization, texture=0.0, color=0.4)
    keys = jax.random.split(jax.random.key(1), len(ROWS))
    physics = make_randomize(ranges, scene)(physics, keys)
  found = images(plain, env, state.replace(physics=physics))
  kinematics = make_kinematics(scene)(physics)
  for camera, image in zip(make_cameras(CONFIG, scene), found, strict=True):
    expected = np.asarray(jax.jit(camera)(kinematics)).astype(int)
    difference = np.abs(image.astype(int) - expected).max(-1)
    # Edges and the shades of curved surfaces differ.
    assert (difference < 25).mean() > 0.9
    assert expected.std() > 10


def test_unseen_looks_follow_from_version_and_row(strange, plain, env, state):
  first, again = (images(strange, env, state, time=5) for _ in range(2))
  later, known = images(strange, env, state, time=6), images(plain, env, state)
  for a, b, c, d in zip(first, again, later, known, strict=True):
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()  # Noise.
    assert np.abs(a[0].astype(int) - a[1].astype(int)).mean() > 10
    assert np.abs(a.astype(int) - d.astype(int)).mean() > 10
  # Whoever changes these numbers has changed the looks and raises the version.
  look = looks.draw(7, 20)
  assert looks.VERSION == 1
  assert (look.table, len(look.clutter), look.surfaces[:4].tolist()) == FROZEN
  textures = [looks.table_texture(i) for i in range(looks.TABLES)]
  textures += [looks.surface_texture(i) for i in range(looks.SURFACES)]
  assert len({x.tobytes() for x in textures}) == looks.TABLES + looks.SURFACES


def test_clutter_stays_out_of_the_workspace():
  for row in range(200):
    for thing in looks.draw(row, 10).clutter:
      x, y, _ = thing.pos
      assert abs(y) >= 0.36 or x >= 0.76


def test_worlds_that_are_over_are_not_drawn(plain, env, state):
  running = np.array([True, False, True])
  views = make_draw(env, plain)(state, ROWS, running, 0)
  assert all(np.asarray(x[0]).any() and not np.asarray(x[1]).any() for x in views)


def test_area_resize_averages_blocks():
  image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
  small = area_resized(image, 2)
  assert small.shape == (2, 3, 3)
  np.testing.assert_array_equal(
    small[0, 0], np.round(image[:2, :2].mean((0, 1)) + 1e-6)
  )


def test_expert_is_measured_with_its_interval():
  found = transfer_expert(CONFIG, Cell(looks="plain"), episodes=3)
  assert found["episodes"] == 3 and found["sufficient"] == (found["successes"] == 3)
  low, high = found["ci95"]
  assert low <= found["success_rate"] <= high
  assert sum(found["failures"].values()) == 3 - found["successes"]


@pytest.mark.parametrize(
  ("cell", "words"),
  [
    (Cell(physics="bullet-proof"), "'bullet-proof'; choose from mjx, native"),
    (Cell(renderer="paint"), "'paint'; choose from rays, opengl"),
    (Cell(looks="new"), "'new'; choose from trained, plain, unseen"),
    (Cell(looks="unseen"), "unseen needs --renderer opengl"),
  ],
)
def test_unknown_cells_are_refused(cell, words):
  with pytest.raises(ConfigError, match=words):
    transfer_expert(EnvConfig(), cell)


@pytest.mark.slow
@pytest.mark.parametrize("instants", [0, 2])
def test_a_policy_from_pixels_plays_in_opengl(instants, tmp_path: Path, plain):
  env = dataclasses.replace(CONFIG, obs="pixels", time_limit_s=0.6)
  agent = dataclasses.replace(testing.TINY.agent, lstm_instants=instants)
  config = dataclasses.replace(
    testing.TINY, env=env, agent=agent, total_steps=testing.STEPS
  )
  train(config, tmp_path / "run")
  for cell in (Cell(looks="plain"), Cell(renderer="opengl", looks="unseen")):
    found = transfer(tmp_path / "run", cell, episodes=4)
    assert found["episodes"] == 4 and found["mean_length"] <= 4
    assert found["trained"] == "plain"
