"""Demonstration files and recordings: what is made of them is what was seen."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings, strategies as st
import jax
from jax.experimental.compilation_cache import compilation_cache
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from apnpql_jax import testing
from apnpql_jax.cli import main
from apnpql_jax.data import demonstrations, real_arm
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import UserError
from apnpql_jax.sim.physics import START_TIME, Physics, PhysicsState
from apnpql_jax.training import expert
from apnpql_jax.training.rollout import expert_policy, make_player

ENV = dataclasses.replace(testing.TINY.env, time_limit_s=0.9)
CONFIG = dataclasses.replace(testing.TINY, env=ENV)
EPISODES, STEPS = 6, 6
FUZZ = settings(
  max_examples=150,
  deadline=None,
  suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(ENV)


@pytest.fixture(scope="module")
def demos(env) -> Demonstrations:
  return _record(env)


def _record(env: Env) -> Demonstrations:
  return expert.record_expert(env, episodes=EPISODES, seed=0, noise=0.1)


@pytest.fixture
def path(tmp_path, demos) -> Path:
  path = tmp_path / "demos.npz"
  demonstrations.save(path, demos, task="push_plate", control_period_s=0.15)
  return path


def test_a_file_holds_what_was_recorded(path, demos, env):
  loaded = demonstrations.load(path, env.task, env.config.control_period_s)
  assert demos.instants == EPISODES * (STEPS + 1)
  assert demos.first.sum() == EPISODES
  for a, b in zip(loaded, demos, strict=True):
    np.testing.assert_array_equal(a, b)


def test_the_replay_is_what_the_worlds_showed(demos, env):
  """Compared with the worlds themselves, taken through the recorded actions."""
  ring = expert.replay_from_demonstrations(demos, CONFIG, env)
  slots = jax.tree.map(np.asarray, ring.slots)
  length, worlds = slots.action.shape[:2]
  assert (length, worlds) == (8, 4) and int(ring.size) == 8
  begin = np.flatnonzero(demos.first)
  rows = jax.random.split(jax.random.key(0))[0]
  rows = jax.random.randint(rows, (EPISODES,), 0, env.bank_split)
  state, step = env.reset(rows), env.step
  index = np.resize(np.arange(demos.instants), (worlds, length)).T
  for t in range(STEPS + 1):
    seen = jax.tree.map(np.asarray, state.timestep)
    for episode, start in enumerate(begin):
      for at in zip(*np.nonzero(index == start + t), strict=True):
        held = jax.tree.map(lambda x, at=at: x[at], slots.timestep)
        np.testing.assert_allclose(
          held.observation.tool, seen.observation.tool[episode], atol=1e-5
        )
        np.testing.assert_allclose(
          held.observation.objects, seen.observation.objects[episode], atol=1e-5
        )
        assert held.reward == seen.reward[episode]
        assert held.terminated == seen.terminated[episode]
        assert held.truncated == (t == STEPS)
        if at[0] >= t:  # Its column holds the episode from its first instant on.
          np.testing.assert_allclose(
            held.observation.robot, seen.observation.robot[episode], atol=1e-6
          )
          np.testing.assert_allclose(
            held.primitives, seen.primitives[episode], atol=2e-3
          )
        np.testing.assert_array_equal(slots.action[at], demos.action[start + t])
    if t < STEPS:
      action = jnp.asarray(demos.action[begin + t])
      state = step(state, action, jax.random.key(t))


def test_another_file_needs_no_other_program(demos, env, tmp_path):
  """Two files of different lengths, converted with an empty compilation cache."""
  names = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
  before = {name: getattr(jax.config, name) for name in names}
  compilation_cache.reset_cache()
  for name, value in zip(names, (str(tmp_path), 0.0), strict=True):
    jax.config.update(name, value)
  try:
    programs = []
    for end in (STEPS + 1, 2 * (STEPS + 1)):
      some = Demonstrations(*(x[:end] for x in demos))
      expert.replay_from_demonstrations(some, CONFIG, env)
      programs.append(sorted(path.name for path in tmp_path.glob("jit_remake-*-cache")))
  finally:
    for name, value in before.items():
      jax.config.update(name, value)
    compilation_cache.reset_cache()
  assert len(programs[0]) == 1 and programs[0] == programs[1]


def test_the_file_has_the_requested_name(tmp_path, demos, env):
  for name in ("demos", "demos.v1", "demos.npz"):
    summary = demonstrations.save(
      tmp_path / name, demos, task="push_plate", control_period_s=0.15
    )
    assert summary["file"] == str(tmp_path / name)
    assert (
      demonstrations.load(
        Path(summary["file"]), env.task, env.config.control_period_s
      ).instants
      == demos.instants
    )
  assert len(list(tmp_path.iterdir())) == 3


class Breaking:
  """The engine of the worlds, in which world 2 breaks in its third period."""

  def __init__(self, engine: Physics):
    self._engine, self.name, self.scene = engine, engine.name, engine.scene

  def step(self, state: PhysicsState, velocity: Any, close: Any) -> PhysicsState:
    moved = self._engine.step(state, velocity, close)
    late = moved.time[2] > START_TIME + 2.5 * 0.15
    return moved.replace(
      qvel=moved.qvel.at[2, 0].set(jnp.where(late, jnp.nan, moved.qvel[2, 0]))
    )


def test_a_non_finite_episode_is_left_out(demos, env):
  broken = Env(env.config, env.task, env._bank)
  broken.physics = Breaking(env.physics)
  rest = _record(broken)
  kept = np.cumsum(demos.first) != 3
  assert rest.first.sum() == EPISODES - 1
  for a, b in zip(rest, demos, strict=True):
    np.testing.assert_allclose(a, b[kept], atol=1e-5)


def test_an_episode_ends_where_its_world_breaks(env):
  broken = Env(env.config, env.task, env._bank)
  broken.physics = Breaking(env.physics)
  play = make_player(broken, lambda _: expert_policy(broken, noise=0.0))
  played = play(None, jnp.arange(EPISODES), jax.random.key(0))
  assert (played.length[2], played.success[2]) == (2, False)
  sound = np.arange(EPISODES) != 2
  assert (played.length[sound] == STEPS).all()
  assert np.isfinite(played.states.qvel[:, 2]).all()


WRONG = {
  "action": (lambda x: x + 1.5, "action is not within"),
  "qpos": (lambda x: x * np.nan, "qpos is not finite at instant 0"),
  "qvel": (lambda x: x[:, :-1], r"qvel is float32\[42, 15\], not \[42, 16\]"),
  "mocap_quat": (lambda x: x * 2, "quaternion is not of unit length"),
  "variant": (lambda x: x + 1, "variant is not one of the scene's"),
  "first": (lambda x: ~x, "first instant must begin"),
}


@pytest.mark.parametrize("name", WRONG)
def test_states_that_the_scene_cannot_have_are_rejected(path, demos, env, name):
  change, message = WRONG[name]
  wrong = demos._replace(**{name: change(getattr(demos, name))})
  demonstrations.save(path, wrong, task="push_plate", control_period_s=0.15)
  with pytest.raises(UserError, match=message):
    demonstrations.load(path, env.task, env.config.control_period_s)


def test_other_files_are_refused_by_name(path, demos, env):
  demonstrations.save(path, demos, task="stack_box", control_period_s=0.15)
  with pytest.raises(UserError, match="has task stack_box, not push_plate"):
    demonstrations.load(path, env.task, env.config.control_period_s)
  demonstrations.save(path, demos, task="push_plate", control_period_s=0.1)
  with pytest.raises(UserError, match=r"control_period_s 0\.1, not 0\.15"):
    demonstrations.load(path, env.task, env.config.control_period_s)
  np.savez(path, format=demonstrations.FORMAT, version=2)
  with pytest.raises(UserError, match="lacks arrays or has extra ones: action"):
    demonstrations.load(path, env.task, env.config.control_period_s)
  with pytest.raises(UserError, match="not an .npz archive"):
    demonstrations.load(path.with_name("none"), env.task, env.config.control_period_s)


@FUZZ
@given(
  st.sampled_from(sorted({*Demonstrations._fields, "format", "version", "task"})),
  st.one_of(
    st.integers(-(2**62), 2**62), st.floats(), st.text(max_size=5), st.booleans()
  ),
  st.lists(st.integers(0, 5), max_size=3),
)
def test_a_replaced_array_is_rejected(path, env, name, value, shape):
  arrays: dict[str, Any] = dict(np.load(path, allow_pickle=False))
  changed: dict[str, Any] = arrays | {name: np.full(shape, value)}
  np.savez(path, **changed)
  try:
    demonstrations.load(path, env.task, env.config.control_period_s)
  except UserError as error:
    assert "\n" not in str(error)
  else:
    assert np.array_equal(np.full(shape, value).astype(str), arrays[name].astype(str))
  finally:
    np.savez(path, **arrays)


def _recording(env: Env, demos: Demonstrations) -> dict[str, Any]:
  """The episodes as somebody would have measured them, three times as often."""
  free, _ = env.task.scene.free_joint("plate")
  finger = env.task.scene.gripper_qpos
  times, parts, period = [], [], 0.15
  for start in np.flatnonzero(demos.first):
    coarse = period * np.arange(STEPS + 1)
    fine = np.linspace(0, coarse[-1], 3 * STEPS + 1)
    rows = slice(start, start + STEPS + 1)
    plate = demos.qpos[rows, free : free + 7]
    turned = Slerp(coarse, Rotation.from_quat(plate[:, 3:], scalar_first=True))(fine)
    quat = turned.as_quat(scalar_first=True)
    quat[1::2] *= -1  # As trackers do.
    line = lambda x, c=coarse, f=fine: np.stack([np.interp(f, c, y) for y in x.T], 1)  # noqa: E731
    goal = np.concatenate([demos.mocap_pos[start, 0], demos.mocap_quat[start, 0]])
    times.append(fine + 100 * start)
    parts.append(
      {
        "joints": line(demos.qpos[rows, env.task.scene.arm_qpos]),
        "gripper": line(demos.qpos[rows, finger : finger + 1] / 1.1)[:, 0],
        "plate": np.concatenate([line(plate[:, :3]), quat], 1),
        "goal": np.tile(goal, (len(fine), 1)),
        "episode": np.full(len(fine), start),
      }
    )
  joined = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
  return joined | {"time": np.concatenate(times)}


def test_a_recording_becomes_the_demonstrations_it_was_made_of(tmp_path, demos, env):
  path = tmp_path / "recording.npz"
  np.savez(path, **_recording(env, demos))
  made = real_arm.convert(path, env.task.scene, period_s=0.15)
  np.testing.assert_array_equal(made.first, demos.first)
  robot = env.task.scene.arm_qpos
  np.testing.assert_allclose(made.qpos[:, robot], demos.qpos[:, robot], atol=1e-5)
  np.testing.assert_allclose(made.qpos[:, 10:13], demos.qpos[:, 10:13], atol=1e-5)
  inner = abs((made.qpos[:, 13:] * demos.qpos[:, 13:]).sum(1))
  np.testing.assert_allclose(inner, 1.0, atol=1e-5)
  np.testing.assert_allclose(made.mocap_pos, demos.mocap_pos, atol=1e-6)
  # The velocity that leads from one instant to the next, by the joints themselves.
  inside = np.flatnonzero(~demos.first) - 1
  moved = (demos.qpos[inside + 1][:, robot] - demos.qpos[inside][:, robot]) / 0.15
  np.testing.assert_allclose(made.action[inside, :6], moved.clip(-1, 1), atol=1e-4)
  np.testing.assert_allclose(made.qvel[inside, :6], moved, atol=1e-4)


def test_an_even_turn_is_even_between_samples_of_either_sign(tmp_path, demos, env):
  """A tracker may return q or -q; control periods end between its samples."""
  free, _ = env.task.scene.free_joint("plate")
  start, time = demos.qpos[0], 0.2 * np.arange(6)
  turn = Rotation.from_euler("z", 0.5 * time[:, None])
  quat = turn.as_quat(scalar_first=True) * (-1.0) ** np.arange(6)[:, None]
  place = np.tile(start[free : free + 3], (6, 1))
  goal = np.concatenate([demos.mocap_pos[0, 0], demos.mocap_quat[0, 0]])
  path = tmp_path / "recording.npz"
  np.savez(
    path,
    time=time,
    joints=np.tile(start[env.task.scene.arm_qpos], (6, 1)),
    gripper=np.ones(6),
    plate=np.concatenate([place, quat], 1),
    goal=np.tile(goal, (6, 1)),
    episode=np.zeros(6),
  )
  made = real_arm.convert(path, env.task.scene, period_s=0.15)
  found = Rotation.from_quat(made.qpos[:, free + 3 : free + 7], scalar_first=True)
  angle = 0.5 * 0.15 * np.arange(7)
  np.testing.assert_allclose(found.as_rotvec()[:, 2], angle, atol=1e-4)


def test_an_incomplete_recording_is_rejected_by_name(tmp_path, demos, env):
  whole, path = _recording(env, demos), tmp_path / "recording.npz"

  def refused(match: str, **changes: np.ndarray | None) -> None:
    changed: dict[str, Any] = {
      k: v for k, v in (whole | changes).items() if v is not None
    }
    np.savez(path, **changed)
    with pytest.raises(UserError, match=match):
      real_arm.convert(path, env.task.scene, period_s=0.15)

  refused("lacks the poses of goal, plate, from which rewards", plate=None, goal=None)
  refused("time must increase", time=-whole["time"])
  refused("joints must be numbers of shape", joints=whole["joints"][:, :5])
  refused("moves at .* rad/s", joints=5 * whole["joints"])
  refused("unknown arrays .'camera'", camera=np.zeros(3))
  refused("gripper is not finite", gripper=whole["gripper"] * np.nan)
  refused("time must be numbers", time=None)
  refused("time must be numbers", time=np.array(0.0))
  refused("quaternion of plate is not of unit", plate=0 * whole["plate"])
  refused("variant must be one whole number", variant=np.zeros(2, int))
  refused("variant is not one of the scene's", variant=np.array(2**40))
  # Two instants a year apart ask for no memory.
  refused("two samples are 500 s apart", time=1e4 * whole["time"])


@FUZZ
@given(
  st.sampled_from("time joints gripper plate goal episode variant".split()),
  st.one_of(
    st.integers(-(2**62), 2**62), st.floats(), st.text(max_size=5), st.booleans()
  ),
  st.one_of(st.none(), st.lists(st.integers(0, 5), max_size=3)),
)
def test_a_recording_is_refused_in_one_line_or_becomes_demonstrations(
  tmp_path, demos, env, name, value, shape
):
  """One array in place of another, or one number in place of another."""
  whole, path = _recording(env, demos), tmp_path / "recording.npz"
  if shape is None and name != "variant" and not isinstance(value, str):
    whole[name] = np.asarray(whole[name], np.float64)
    whole[name].flat[7] = value
  else:
    whole[name] = np.full(shape or (), value)
  np.savez(path, **whole)
  try:
    made = real_arm.convert(path, env.task.scene, period_s=0.15)
  except UserError as error:
    assert "\n" not in str(error) and str(path) in str(error)
  else:
    demonstrations.check(made, env.task.scene)


def test_the_command_converts_a_recording(tmp_path, demos, env):
  recording, out = tmp_path / "recording.npz", tmp_path / "mine.npz"
  np.savez(recording, **_recording(env, demos))
  assert main.main(["convert", str(recording), "push_plate", str(out)]) == 0
  assert (
    demonstrations.load(out, env.task, env.config.control_period_s).instants
    == demos.instants
  )
