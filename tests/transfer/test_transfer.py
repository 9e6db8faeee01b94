"""Transfer: the loop over time, OpenGL against the ray caster, unseen looks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
import dataclasses
from pathlib import Path
from typing import Any

from hand_made import painted
import imageio.v3 as iio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from render_oracles import cast_rays

from apnpql_jax import testing
from apnpql_jax.colors import geom_rgba
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.errors import ConfigError
from apnpql_jax.randomization.randomize import make_randomize
from apnpql_jax.render import Geoms, Lighting
from apnpql_jax.sim.graphics import area_resized
from apnpql_jax.sim.physics import START_TIME
from apnpql_jax.sim.scene import Scene, free_joints, load_scene
from apnpql_jax.tasks import make_task
from apnpql_jax.training import evaluate
from apnpql_jax.training.rollout import expert_policy, make_player
from apnpql_jax.training.train import train
from apnpql_jax.training.video import HOLD
from apnpql_jax.transfer import looks, outcome_video, tiny_renderer
from apnpql_jax.transfer.bullet_worlds import BulletWorlds
from apnpql_jax.transfer.condition import Condition
from apnpql_jax.transfer.evaluation import evaluate_expert, evaluate_run, make_draw
from apnpql_jax.transfer.host_rollout import EpisodeBatch, play
from apnpql_jax.transfer.opengl_renderer import OpenGLRenderer
from apnpql_jax.transfer.tiny_renderer import TinyRenderer

CONFIG = dataclasses.replace(testing.TINY.env, task="push_plate")

FROZEN = (58809.89372251599, 910959343.7217898, 217969202.88784555)
"""Sums of ``weighted`` over the unseen looks at rows 0 to 49, over all textures, and
over a photograph of gray."""


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(CONFIG)


@pytest.fixture(scope="module")
def plain(env: Env) -> Iterator[OpenGLRenderer]:
  yield from opened(env.task.scene, OpenGLRenderer, unseen=())


def opened(scene: Scene, renderer: type, *, unseen: Collection[str]) -> Iterator[Any]:
  if renderer is TinyRenderer:
    pytest.importorskip("pybullet")
  try:
    gl = renderer(scene, CONFIG, unseen=unseen)
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


def images(
  gl: OpenGLRenderer, env: Env, state: EnvState, time: int = 0
) -> list[np.ndarray]:
  """Returns the images of the worlds."""
  views = make_draw(env, gl)(state.physics, ROWS, np.ones(len(ROWS), bool), time)
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


def test_bullet_moves_the_worlds_that_still_run(env):
  """The state holds Bullet's poses, and an episode continues without a reset."""
  pytest.importorskip("pybullet")
  state, act = env.reset(jnp.asarray(ROWS)), jax.jit(env.expert_action)
  running = np.array([True, True, False])
  with BulletWorlds(env, latency_s=0.0, admittance=False) as worlds:
    for _ in range(3):
      before = state.physics
      state = env.observe(worlds.advance(state, act(state), running))
      for world in (0, 1):
        qpos, qvel = worlds.plants[world].bodies.state()
        np.testing.assert_allclose(state.physics.qpos[world], qpos, atol=1e-6)
        np.testing.assert_allclose(state.physics.qvel[world], qvel, atol=1e-5)
    moved = np.abs(state.physics.qpos - before.qpos)[:, env.task.scene.arm_qpos].max(1)
    assert (moved[:2] > 0.01).all() and moved[2] == 0.0
  assert state.elapsed.tolist() == [3, 3, 3] and not state.faults.any()
  period = env.config.control_period_s
  np.testing.assert_allclose(state.physics.time[0] - START_TIME, 3 * period, rtol=1e-5)


def test_a_world_that_bullet_breaks_counts_as_a_fault(env, monkeypatch):
  pytest.importorskip("pybullet")
  state = env.reset(jnp.asarray(ROWS))
  with BulletWorlds(env, latency_s=0.0, admittance=False) as worlds:
    worlds.advance(state, jnp.zeros((3, 7)), np.ones(3, bool))
    nothing = (
      np.full(env.task.scene.model.nq, np.nan),
      worlds.plants[1].bodies.state()[1],
    )
    monkeypatch.setattr(worlds.plants[1].bodies, "state", lambda: nothing)
    later = state.replace(elapsed=state.elapsed + 1)
    arrival = worlds.advance(later, jnp.zeros((3, 7)), np.ones(3, bool))
  assert arrival.faults.tolist() == [0, 1, 0]


def test_video_shows_the_first_success_and_the_first_failure():
  nothing: Any = None
  batches = [
    EpisodeBatch(np.array(solved), nothing, [], nothing, nothing, nothing)
    for solved in ([True, True], [False, True])
  ]
  assert outcome_video.first(batches, success=True) == 0
  assert outcome_video.first(batches, success=False) == 2
  assert outcome_video.first(batches[:1], success=False) is None


@pytest.mark.parametrize("renderer", [OpenGLRenderer, TinyRenderer])
@pytest.mark.parametrize("randomize", [False, True])
def test_others_see_what_the_ray_caster_sees(randomize, renderer, env, state):
  scene, physics = env.task.scene, state.physics
  if randomize:
    # Neither draws checkers or waves.
    ranges = dataclasses.replace(CONFIG.randomization, texture=0.0, color=0.4)
    keys = jax.random.split(jax.random.key(1), len(ROWS))
    physics = jax.jit(make_randomize(ranges, scene))(physics, keys)
  (found,) = (
    images(plain, env, state.replace(physics=physics))
    for plain in opened(scene, renderer, unseen=())
  )
  kinematics = env.poses(physics)
  for camera, image in zip(make_cameras(CONFIG, scene), found, strict=True):
    expected = np.asarray(jax.jit(camera)(kinematics)).astype(int)
    difference = np.abs(image.astype(int) - expected).max(-1)
    # Edges, the shades of curved surfaces and, in TinyRenderer, the hand's shadow
    # differ.
    assert (difference < 25).mean() > 0.9
    assert expected.std() > 10


@pytest.mark.parametrize("renderer", [OpenGLRenderer, TinyRenderer])
def test_background_has_the_color_of_the_ray_caster(renderer):
  """The wrist camera of this task sees beyond the table."""
  scene = make_task("flip_cup").scene
  data = mujoco.MjData(scene.model)
  data.qpos[:] = scene.keyframe("neutral")
  mujoco.mj_forward(scene.model, data)
  names = "geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat"
  poses = {name: np.array(getattr(data, name)) for name in names}
  expected = 255 * np.array(Lighting().background)
  for gl in opened(scene, renderer, unseen=()):
    _, wrist = gl.draw(poses, {}, row=0, instant=0)
    sky = (np.abs(wrist - expected) < 1).all(-1)
    assert sky.mean() > 0.02 and sky[0].any()


@pytest.mark.parametrize("renderer", [OpenGLRenderer, TinyRenderer])
def test_materials_and_textures_have_the_color_of_the_ray_caster(renderer, tmp_path):
  """With and without colors of the world in place of the model's."""
  scene = load_scene(painted(tmp_path))
  model = scene.model
  data = mujoco.MjData(model)
  data.qpos[:] = scene.keyframe("neutral")
  mujoco.mj_forward(model, data)
  names = "geom_xpos", "geom_xmat", "cam_xpos", "cam_xmat"
  poses = {name: np.array(getattr(data, name)) for name in names}
  ids, _, _ = cast_rays(model, data, "global", *CONFIG.global_size)
  colors = np.asarray(Geoms.from_model(model).colors)
  rows = Geoms.from_model(model).ids.tolist()
  for gl in opened(scene, renderer, unseen=()):
    fields: dict[str, np.ndarray]
    for fields in ({}, {"geom_rgba": geom_rgba(model)}):
      image = gl.draw(poses, fields, row=0, instant=0)[0].astype(float)
      for name in ("crate", "plate_floor"):
        seen = image[ids == model.geom(name).id]
        assert len(seen) > 15
        hue = seen.mean(0) / seen.mean()
        color = colors[rows.index(model.geom(name).id)]
        np.testing.assert_allclose(hue, color / color.mean(), atol=0.15)


@pytest.mark.parametrize("renderer", [OpenGLRenderer, TinyRenderer])
def test_unseen_looks_follow_from_version_and_row(renderer, env, state):
  (first, again, later), (known,) = (
    [images(drawing, env, state, time=time) for time in times]
    for unseen, times in ((looks.PARTS, (5, 5, 6)), ((), (0,)))
    for drawing in opened(env.task.scene, renderer, unseen=unseen)
  )
  for a, b, c, d in zip(first, again, later, known, strict=True):
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()  # Noise.
    assert np.abs(a[0].astype(int) - a[1].astype(int)).mean() > 10
    assert np.abs(a.astype(int) - d.astype(int)).mean() > 10


def test_tiny_keeps_few_worlds_loaded(env, state, monkeypatch):
  monkeypatch.setattr(tiny_renderer, "KEPT", 2)
  for strange in opened(env.task.scene, TinyRenderer, unseen=looks.PARTS):
    for view, other in zip(
      images(strange, env, state), images(strange, env, state), strict=True
    ):
      np.testing.assert_array_equal(view, other)
    assert len(strange._worlds) == 2


def test_unseen_looks_stay_those_of_their_version():
  """Whoever changes these numbers has changed the looks and raises the version."""
  assert looks.VERSION == 1
  drawn = [looks.draw(row, 20) for row in range(50)]
  textures = [looks.table_texture(i) for i in range(looks.TABLES)]
  textures += [looks.surface_texture(i) for i in range(looks.SURFACES)]
  assert len({x.tobytes() for x in textures}) == looks.TABLES + looks.SURFACES
  gray, noise = np.full((36, 64, 3), 128, np.uint8), np.random.default_rng(0)
  photographs = [looks.photograph(gray, look, 0, noise) for look in drawn]
  found = weighted(drawn), weighted(textures), weighted(photographs)
  np.testing.assert_allclose(found, FROZEN, rtol=1e-7)


def weighted(tree: Any) -> float:
  """Returns a sum over all numbers of a tree, each with a weight of its own."""
  if dataclasses.is_dataclass(tree):
    tree = list(vars(tree).values())
  if isinstance(tree, (list, tuple)):
    return sum(weighted(x) * (1 + 0.1 * i) for i, x in enumerate(tree))
  values = np.asarray(tree, float).ravel()
  return float(values @ np.linspace(1.0, 2.0, len(values)))


@pytest.mark.parametrize("renderer", [OpenGLRenderer, TinyRenderer])
def test_each_part_of_unseen_looks_changes_the_images(renderer, env, state):
  found = []
  chosen = [set(looks.PARTS) - {part} for part in looks.PARTS]
  for unseen in (looks.PARTS, *chosen):
    for drawing in opened(env.task.scene, renderer, unseen=unseen):
      found.append(np.concatenate([x.ravel() for x in images(drawing, env, state)]))
  assert len({x.tobytes() for x in found}) == 1 + len(looks.PARTS)


@pytest.mark.parametrize("part", looks.PARTS)
def test_a_part_of_unseen_looks_is_one_change_of_plain_ones(part, plain, env, state):
  known, everywhere = images(plain, env, state), ("surfaces", "lights", "camera")
  for drawing in opened(env.task.scene, OpenGLRenderer, unseen=[part]):
    difference = np.abs(images(drawing, env, state)[0].astype(int) - known[0])
    changed = (difference > 4).any(-1).mean()
    assert changed > 0.5 if part in everywhere else 0.005 < changed < 0.5


@pytest.mark.parametrize("name", ["push_plate", "stack_box", "flip_cup", "place_plate"])
def test_clutter_stays_out_of_the_workspace(name):
  """The centers of objects and goals are 7 cm from the edges of all things."""
  task = make_task(name)
  free = free_joints(task.scene.model)
  draws = task.sample_resets(np.random.default_rng(0), 200)
  for row, (qpos, goals) in enumerate(zip(draws.qpos, draws.mocap_pos, strict=True)):
    objects = [qpos[i : i + 2] for i in task.scene.model.jnt_qposadr[free]]
    for thing in looks.draw(row, 10).clutter:
      boxes = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID
      radius = np.linalg.norm(thing.size[: 2 if thing.shape in boxes else 1])
      places = np.array([*objects, *goals[:, :2]])
      distances = np.linalg.norm(places - thing.pos[:2], axis=-1)
      assert distances.min() - radius > 0.07


def test_worlds_that_are_over_are_not_drawn(plain, env, state):
  running = np.array([True, False, True])
  views = make_draw(env, plain)(state.physics, ROWS, running, 0)
  assert all(np.asarray(x[0]).any() and not np.asarray(x[1]).any() for x in views)


def test_area_resize_averages_blocks():
  image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
  small = area_resized(image, 2)
  assert small.shape == (2, 3, 3)
  np.testing.assert_array_equal(
    small[0, 0], np.round(image[:2, :2].mean((0, 1)) + 1e-6)
  )


def test_expert_is_measured_with_its_interval(monkeypatch):
  """In two batches of two, of which the last episode does not count."""
  monkeypatch.setattr(evaluate, "MAX_WORLDS", 2)
  found = evaluate_expert(CONFIG, Condition(looks="plain"), episodes=3)
  assert found["episodes"] == 3 and found["sufficient"] == (found["successes"] == 3)
  low, high = found["ci95"]
  assert low <= found["success_rate"] <= high
  assert found["success_rate"] == pytest.approx(found["successes"] / 3)
  assert sum(found["failures"].values()) == 3 - found["successes"]
  assert len(found["failed_rows"]) == 3 - found["successes"]


@pytest.mark.parametrize(
  ("condition", "words"),
  [
    (Condition(physics="bullet-proof"), "'bullet-proof'; choose from mjx, native"),
    (Condition(renderer="paint"), "'paint'; choose from rays, opengl"),
    (Condition(looks="new"), "'new'; choose from trained, plain, unseen"),
    (Condition(looks="unseen"), "unseen needs --renderer opengl"),
    (
      Condition(renderer="opengl", without=("clutter",)),
      "--without needs --looks unseen",
    ),
    (
      Condition(renderer="opengl", looks="unseen", without=("dust",)),
      "'dust'; choose from surfaces, lights, shadows",
    ),
  ],
)
def test_unknown_conditions_are_refused(condition, words):
  with pytest.raises(ConfigError, match=words):
    evaluate_expert(EnvConfig(), condition)


@pytest.mark.slow
@pytest.mark.parametrize("instants", [0, 2])
def test_a_policy_from_pixels_plays_in_opengl(instants, tmp_path: Path, plain):
  env = dataclasses.replace(CONFIG, obs="pixels", time_limit_s=0.6)
  agent = dataclasses.replace(testing.TINY.agent, lstm_instants=instants)
  config = dataclasses.replace(
    testing.TINY, env=env, agent=agent, total_steps=testing.STEPS
  )
  train(config, tmp_path / "run")
  for condition in (
    Condition(looks="plain"),
    Condition(renderer="opengl", looks="unseen"),
  ):
    video = tmp_path / f"{condition.renderer}.mp4"
    found = evaluate_run(tmp_path / "run", condition, episodes=4, video=video)
    assert found["video"] == str(video)
    assert set(found["video_episodes"].values()) != {None}
    assert iio.imread(video).shape[0] <= 2 * (4 + HOLD)
    assert found["episodes"] == 4 and found["mean_length"] <= 4
    assert found["trained"] == "plain"
