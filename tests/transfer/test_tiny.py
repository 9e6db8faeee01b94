"""TinyRenderer against the ray caster, and its unseen looks."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.transfer import looks, tiny
from apnpql_jax.transfer.tiny import Tiny
from apnpql_jax.transfer.transfer import make_draw

CONFIG = dataclasses.replace(testing.TINY.env, task="push_plate")
ROWS = np.arange(3)


@pytest.fixture(scope="module")
def env() -> Env:
  pytest.importorskip("pybullet")
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def plain(env: Env) -> Iterator[Tiny]:
  with Tiny(env.task.scene, CONFIG, unseen=()) as renderer:
    yield renderer


@pytest.fixture(scope="module")
def state(env: Env) -> PhysicsState:
  """Returns the worlds at ``ROWS`` of the bank."""
  return env.reset(jnp.asarray(ROWS)).physics


def images(
  renderer: Tiny, env: Env, state: PhysicsState, time: int = 0
) -> list[np.ndarray]:
  """Returns the images of the worlds."""
  views = make_draw(env, renderer)(state, ROWS, np.ones(len(ROWS), bool), time)
  return [np.asarray(view) for view in views]


@pytest.mark.parametrize("randomize", [False, True])
def test_tiny_sees_what_the_ray_caster_sees(randomize, plain, env, state):
  scene = env.task.scene
  if randomize:
    # TinyRenderer draws no checkers and no waves.
    ranges = dataclasses.replace(CONFIG.randomization, texture=0.0, color=0.4)
    keys = jax.random.split(jax.random.key(1), len(ROWS))
    state = jax.jit(make_randomize(ranges, scene))(state, keys)
  found = images(plain, env, state)
  kinematics = env.poses(state)
  for camera, image in zip(make_cameras(CONFIG, scene), found, strict=True):
    expected = np.asarray(jax.jit(camera)(kinematics)).astype(int)
    difference = np.abs(image.astype(int) - expected).max(-1)
    # Edges, the shades of curved surfaces and the hand's shadow differ.
    assert (difference < 25).mean() > 0.9
    assert expected.std() > 10


def test_unseen_looks_differ_by_row_and_noise_by_time(plain, env, state):
  with Tiny(env.task.scene, CONFIG, unseen=looks.PARTS) as strange:
    first, again = (images(strange, env, state, time=5) for _ in range(2))
    later, known = images(strange, env, state, time=6), images(plain, env, state)
  for a, b, c, d in zip(first, again, later, known, strict=True):
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()  # Noise.
    assert np.abs(a[0].astype(int) - a[1].astype(int)).mean() > 10
    assert np.abs(a.astype(int) - d.astype(int)).mean() > 10


def test_few_worlds_stay_loaded(env, state, plain, monkeypatch):
  monkeypatch.setattr(tiny, "KEPT", 2)
  with Tiny(env.task.scene, CONFIG, unseen=looks.PARTS) as strange:
    for view, other in zip(
      images(strange, env, state), images(strange, env, state), strict=True
    ):
      np.testing.assert_array_equal(view, other)
    assert len(strange._worlds) == 2


@pytest.mark.parametrize("name", "SPHERE CAPSULE ELLIPSOID CYLINDER BOX".split())
def test_shapes_of_clutter_have_the_silhouettes_of_mujoco(name, tmp_path):
  """Against the distance to the surface along each ray, by MuJoCo."""
  pytest.importorskip("pybullet")
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><worldbody><geom type='{name.lower()}' size='0.04 0.05 0.03' "
    "euler='30 20 10' rgba='1 0 0 1'/></worldbody></mujoco>"
  )
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  geoms = tiny.Geoms.from_model(model)
  world = tiny._World(model, geoms, model.geom_size, tmp_path)
  world.place(data.geom_xpos, data.geom_xmat)
  mat = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
  height, width, fovy = 80, 120, 30.0
  eye = np.array([0.0, 0.0, 0.4])
  lighting = {"lightDirection": [0, 0, 1], "shadow": 0}
  seen = world.image((height, width), eye, mat, fovy, lighting)[..., 3] > 0
  slope = np.tan(np.radians(fovy) / 2)
  rows = slope * (1 - 2 * (np.arange(height) + 0.5) / height)
  columns = slope * width / height * (2 * (np.arange(width) + 0.5) / width - 1)
  expected = np.zeros((height, width), bool)
  for i, y in enumerate(rows):
    for j, x in enumerate(columns):
      ray = np.array([x, y, -1.0])
      hit = np.array([-1], np.int32)
      expected[i, j] = mujoco.mj_ray(model, data, eye, ray, None, 1, -1, hit) >= 0
  world.client.disconnect()
  assert expected.sum() > 500
  assert (seen == expected).mean() > 0.97
