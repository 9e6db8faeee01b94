"""Demonstration files and recordings: what is made of them is what was seen."""

from __future__ import annotations

import dataclasses
import itertools
import json
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
from apnpql_jax.data import demonstrations, recordings
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import UserError
from apnpql_jax.sim.names import ARM_JOINTS
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


def _load(path: Path, env: Env) -> Demonstrations:
  return demonstrations.load(path, env.task, env.config, allow_unsolved=True)


@pytest.fixture(scope="module")
def whole() -> tuple[Env, Demonstrations]:
  """Returns worlds with time to solve the task, and episodes of the expert that do."""
  env = make_env(testing.TINY.env)
  demos = expert.record_expert(env, episodes=4, seed=0, noise=0.0)
  assert demonstrations.solved(demos, env.task, env.config).all()
  return env, demos


@pytest.fixture
def path(tmp_path, demos) -> Path:
  path = tmp_path / "demos.npz"
  demonstrations.save(path, demos, task="push_plate", control_period_s=0.15)
  return path


def test_a_file_holds_what_was_recorded(path, demos, env):
  loaded = _load(path, env)
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
  index = begin[:worlds] + np.arange(length)[:, None]  # Each column holds one whole.
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
        np.testing.assert_allclose(
          held.observation.robot, seen.observation.robot[episode], atol=1e-6
        )
        np.testing.assert_allclose(held.primitives, seen.primitives[episode], atol=2e-3)
        np.testing.assert_array_equal(slots.action[at], demos.action[start + t])
    if t < STEPS:
      action = jnp.asarray(demos.action[begin + t])
      state = step(state, action, jax.random.key(t))


def test_randomized_episodes_differ_in_what_is_seen_alone(demos):
  """Each draws its colors and cameras once, also where the file repeats."""
  images = {"obs": "pixels", "global_size": (12, 16), "wrist_size": (8, 8)}
  plain = dataclasses.replace(CONFIG, env=dataclasses.replace(ENV, **images))
  replay = dataclasses.replace(CONFIG.replay, expert_steps=96)
  plain = dataclasses.replace(plain, replay=replay)
  wild = dataclasses.replace(plain, env=dataclasses.replace(plain.env, randomize=True))
  both = [
    expert.replay_from_demonstrations(demos, config, make_env(config.env)).slots
    for config in (plain, wild)
  ]
  (one, other), images = both, ["global_image", "wrist_image"]
  for name in ("reward", "terminated", "truncated", "primitives"):
    np.testing.assert_allclose(
      getattr(one.timestep, name), getattr(other.timestep, name), atol=1e-5
    )
  np.testing.assert_array_equal(one.action, other.action)
  for name in ("robot", "tool"):
    x, y = (getattr(slots.timestep.observation, name) for slots in both)
    np.testing.assert_allclose(x, y, atol=1e-5)
  seen = np.asarray(other.timestep.observation.global_image, np.float32)
  # The mean color is about that of the slot before, unless an episode begins.
  color = seen.mean((2, 3))
  change = np.abs(np.diff(color, axis=0)).max(-1)
  # Columns of three episodes and a part of the fourth, with which the next one begins.
  index = (21 * np.arange(4) + np.arange(24)[:, None]) % demos.instants
  begins = demos.first[index][1:]
  assert begins.sum() > 8
  assert np.median(change[begins]) > 5 * np.median(change[~begins])
  # The same episode, drawn twice.
  assert index[0, 0] == index[21, 1] and demos.first[index[0, 0]]
  assert np.abs(color[0, 0] - color[21, 1]).max() > 2
  assert (np.asarray(one.timestep.observation.global_image) != seen).any()


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
      found = tmp_path.glob("jit__observe_all-*-cache")
      programs.append(sorted(path.name for path in found))
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
    assert _load(Path(summary["file"]), env).instants == demos.instants
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
  "qvel": (lambda x: x[:, :-1], r"qvel is float32\[42, 15\], not float\[42, 16\]"),
  "mocap_pos": (
    lambda x: x.astype(int),
    r"mocap_pos is int64\[.*, not float\[42, 1, 3",
  ),
  "mocap_quat": (lambda x: x * 2, "quaternion is not of unit length"),
  "variant": (lambda x: x + 1, "variant is not one of the scene's"),
  "first": (lambda x: x | True, "first begins an episode at every instant"),
}


@pytest.mark.parametrize("name", WRONG)
def test_states_that_the_scene_cannot_have_are_rejected(path, demos, env, name):
  change, message = WRONG[name]
  wrong = demos._replace(**{name: change(getattr(demos, name))})
  demonstrations.save(path, wrong, task="push_plate", control_period_s=0.15)
  with pytest.raises(UserError, match=message):
    _load(path, env)


def test_other_files_are_refused_by_name(path, demos, env):
  demonstrations.save(path, demos, task="stack_box", control_period_s=0.15)
  with pytest.raises(UserError, match="has task stack_box, not push_plate"):
    _load(path, env)
  demonstrations.save(path, demos, task="push_plate", control_period_s=0.1)
  with pytest.raises(UserError, match=r"control_period_s is 0\.1, not 0\.15"):
    _load(path, env)
  np.savez(path, format=demonstrations.FORMAT, version=2)
  with pytest.raises(UserError, match="has version 2, not 1"):
    _load(path, env)
  rest = {k: v for k, v in demos._asdict().items() if k not in ("first", "qpos")}
  np.savez(path, **rest, version=1, format=demonstrations.FORMAT, q=0)
  with pytest.raises(
    UserError,
    match="missing arrays: control_period_s, first, qpos, task; unknown arrays: q .see",
  ):
    _load(path, env)
  with pytest.raises(UserError, match="cannot read .*none: No such file"):
    _load(path.with_name("none"), env)
  with pytest.raises(UserError, match="cannot read .*: Is a directory"):
    _load(path.parent, env)


def test_the_order_of_bytes_does_not_matter(path, demos, env):
  swapped = Demonstrations(*(x.astype(x.dtype.newbyteorder()) for x in demos))
  demonstrations.save(path, swapped, task="push_plate", control_period_s=0.15)
  ring = expert.replay_from_demonstrations(_load(path, env), CONFIG, env)
  expected = expert.replay_from_demonstrations(demos, CONFIG, env)
  jax.tree.map(np.testing.assert_array_equal, ring, expected)


def test_demonstrations_without_a_solved_episode_are_rejected(path, demos, env):
  with pytest.raises(UserError, match="none of the 6 episodes is solved.*allow-unsol"):
    demonstrations.load(path, env.task, env.config)
  assert _load(path, env).instants == demos.instants


def test_an_episode_is_solved_within_the_time_limit_and_after_its_start(whole):
  env, demos = whole
  begin = np.flatnonzero(demos.first)
  lengths = np.diff([*begin, demos.instants])
  limit = 0.15 * sorted(lengths)[1]
  short = dataclasses.replace(env.config, time_limit_s=limit)
  expected = lengths - 1 <= short.episode_steps
  assert 0 < expected.sum() < len(begin)
  found = demonstrations.solved(demos, env.task, short)
  np.testing.assert_array_equal(found, expected)
  # The solved instants on their own: each begins an episode, and a second one is late.
  ends = demos.rows(np.repeat(np.append(begin[1:], demos.instants) - 1, 2))
  alone = ends._replace(first=np.ones(len(ends.first), bool))
  assert not demonstrations.solved(alone, env.task, env.config).any()
  pairs = ends._replace(first=np.arange(len(ends.first)) % 2 == 0)
  assert demonstrations.solved(pairs, env.task, env.config).all()


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
    _load(path, env)
  except UserError as error:
    assert "\n" not in str(error)
  else:
    assert np.array_equal(np.full(shape, value).astype(str), arrays[name].astype(str))
  finally:
    np.savez(path, **arrays)


CONVENTIONS: dict[str, Any] = {
  "time_unit": "s",
  "angle_unit": "rad",
  "length_unit": "m",
  "quaternion_order": "wxyz",
  "frame": "world",
  "joint_names": np.array(ARM_JOINTS),
  "gripper_range": np.array([0.0, 1.0]),
}


def _recording(
  env: Env, demos: Demonstrations, *, every: float = 0.05, late: float = 0.0
) -> dict[str, Any]:
  """Returns the episodes as measured by somebody: more often, from ``late`` on."""
  free, _ = env.task.scene.free_joint("plate")
  finger = env.task.scene.gripper_qpos
  times, parts = [], []
  begin = np.flatnonzero(demos.first)
  for start, end in zip(begin, [*begin[1:], demos.instants], strict=True):
    coarse = 0.15 * np.arange(end - start)
    fine = np.append(np.arange(late, coarse[-1] - 1e-6, every), coarse[-1])
    rows = slice(start, end)
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
  return CONVENTIONS | joined | {"time": np.concatenate(times)}


def _convert(path: Path, env: Env, recording: dict[str, Any]) -> Demonstrations:
  np.savez(path, **recording)
  return recordings.convert(path, env.task.scene, period_s=0.15)


def test_a_recording_becomes_the_demonstrations_it_was_made_of(tmp_path, demos, env):
  made = _convert(tmp_path / "recording.npz", env, _recording(env, demos))
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
  recording = {
    "time": time,
    "joints": np.tile(start[env.task.scene.arm_qpos], (6, 1)),
    "gripper": np.ones(6),
    "plate": np.concatenate([place, quat], 1),
    "goal": np.tile(goal, (6, 1)),
    "episode": np.zeros(6),
  }
  made = _convert(tmp_path / "recording.npz", env, CONVENTIONS | recording)
  found = Rotation.from_quat(made.qpos[:, free + 3 : free + 7], scalar_first=True)
  angle = 0.5 * np.append(0.0, 1.0 - 0.15 * np.arange(6, -1, -1))
  np.testing.assert_allclose(found.as_rotvec()[:, 2], angle, atol=1e-4)


def test_the_same_episodes_are_solved_wherever_recording_and_clock_start(
  tmp_path, whole
):
  """Only the first period differs, in which the recording begins."""
  env, demos = whole
  path, expected = tmp_path / "recording.npz", None
  for late, origin in itertools.product((0.0, 0.04, 0.11), (0.0, 1.7e9)):
    recording = _recording(env, demos, every=0.008, late=late)
    recording["time"] += origin
    made = _convert(path, env, recording)
    np.testing.assert_array_equal(made.first, demos.first)
    last = np.append(demos.first[1:], True)
    np.testing.assert_allclose(made.qpos[last], demos.qpos[last], atol=2e-3)
    found = demonstrations.solved(made, env.task, env.config)
    expected = found if expected is None else expected
    np.testing.assert_array_equal(found, expected)
  assert expected is not None and expected.sum() >= 2


def test_units_orders_and_frame_are_converted(tmp_path, demos, env):
  """As a UR driver and a Robotiq hand publish them, and a tracker at the arm's base."""
  path, plain = tmp_path / "recording.npz", _recording(env, demos)
  expected = _convert(path, env, plain)
  order = [2, 1, 0, 3, 4, 5]
  other = plain | {
    "time": (1.7e18 + 1e9 * plain["time"]).astype(np.int64),
    "time_unit": "ns",
    "joints": np.degrees(plain["joints"][:, order]),
    "joint_names": np.array([f"ur5e_{ARM_JOINTS[i]}_joint" for i in order], "S"),
    "angle_unit": np.array([b"deg"]),
    "gripper": 255 - (252 * plain["gripper"]).astype(int),
    "gripper_range": np.array([255, 3]),
    "length_unit": "mm",
    "quaternion_order": "xyzw",
    "frame": "base",
  }
  turn = Rotation.from_euler(
    "z", 90, degrees=True
  )  # World to base, see mjcf/robot.xml.
  for name in ("plate", "goal"):
    where, quat = np.split(plain[name], [3], axis=1)
    turned = turn * Rotation.from_quat(quat, scalar_first=True)
    other[name] = np.concatenate([1e3 * turn.apply(where), turned.as_quat()], axis=1)
  made = _convert(path, env, other)
  arm = env.task.scene.arm_qpos
  np.testing.assert_allclose(made.qpos[:, arm], expected.qpos[:, arm], atol=1e-5)
  np.testing.assert_allclose(made.qpos[:, 6:10], expected.qpos[:, 6:10], atol=6e-3)
  np.testing.assert_allclose(made.qpos[:, 10:13], expected.qpos[:, 10:13], atol=1e-5)
  for a, b in (
    (made.qpos[:, 13:], expected.qpos[:, 13:]),
    (made.mocap_quat[:, 0], expected.mocap_quat[:, 0]),
  ):
    np.testing.assert_allclose(abs((a * b).sum(1)), 1.0, atol=1e-5)
  np.testing.assert_allclose(made.mocap_pos, expected.mocap_pos, atol=1e-6)
  np.testing.assert_allclose(made.action, expected.action, atol=1e-4)


def test_an_incomplete_recording_is_rejected_by_name(tmp_path, demos, env):
  whole, path = _recording(env, demos), tmp_path / "recording.npz"

  def refused(match: str, **changes: np.ndarray | None) -> None:
    changed: dict[str, Any] = {
      k: v for k, v in (whole | changes).items() if v is not None
    }
    with pytest.raises(UserError, match=match):
      _convert(path, env, changed)

  refused("lacks the poses of goal, plate, from which rewards", plate=None, goal=None)
  refused("time must increase", time=-whole["time"])
  refused("joints is float64.*must be numbers of", joints=whole["joints"][:, :5])
  refused("moves at .* rad/s", joints=5 * whole["joints"])
  refused("recording.npz: unknown arrays: camera .see docs/", camera=np.zeros(3))
  refused("gripper is not finite", gripper=whole["gripper"] * np.nan)
  refused("missing arrays: time .see docs/", time=None)
  refused("time is float64", time=np.array(0.0))
  refused("Unix time needs float64", time=(1.7e9 + whole["time"]).astype("f4"))
  refused("quaternion of plate is not of unit", plate=0 * whole["plate"])
  refused("variant must be one whole number", variant=np.zeros(2, int))
  refused("variant is not one of the scene's", variant=np.array(2**40))
  # Two instants a year apart ask for no memory.
  refused("two samples are 500 s apart.*time_unit", time=1e4 * whole["time"])
  refused("an episode has only one sample", episode=np.arange(len(whole["time"])))
  # Conventions are never guessed.
  for name in CONVENTIONS:
    refused(f"missing arrays: {name} .see docs/", **{name: None})
  refused("time_unit must be one of the texts s, ms", time_unit=np.array("minutes"))
  refused("quaternion_order must be .* wxyz, xyzw", quaternion_order=np.array(1))
  refused("frame must be one of .* world, base", frame=np.array(["world", "base"]))
  names = np.array(ARM_JOINTS)
  refused("joint_names must name", joint_names=names[:5])
  refused("joint_names must name", joint_names=names[[0, 0, 2, 3, 4, 5]])
  refused("joint_names must name", joint_names=np.arange(6))
  refused("gripper reads 255 at sample 0", gripper=255 * np.ones(len(whole["time"])))
  refused("readings of an open and a closed", gripper_range=np.array([1.0, 1.0]))
  refused("correct angle_unit", joints=np.degrees(whole["joints"]))


@FUZZ
@given(
  st.sampled_from(
    [*"time joints gripper plate goal episode variant".split(), *CONVENTIONS]
  ),
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
  scalar = name == "variant" or name in CONVENTIONS
  if shape is None and not scalar and not isinstance(value, str):
    whole[name] = np.asarray(whole[name], np.float64)
    whole[name].flat[7] = value
  else:
    whole[name] = np.full(shape or (), value)
  try:
    made = _convert(path, env, whole)
  except UserError as error:
    assert "\n" not in str(error) and str(path) in str(error)
  else:
    demonstrations.check(made, env.task.scene)


def test_the_command_converts_a_recording(tmp_path, whole, capfd):
  env, demos = whole
  recording, out = tmp_path / "recording.npz", tmp_path / "mine.npz"
  np.savez(recording, **_recording(env, demos))
  command = ["convert", str(recording), "push_plate", str(out)]
  assert main.main([*command, "--json"]) == 0
  counts = json.loads(capfd.readouterr().out)
  assert counts["demonstrations"] == 4 and counts["solved_demonstrations"] >= 2
  loaded = demonstrations.load(out, env.task, env.config)
  assert loaded.instants == demos.instants


def test_the_command_refuses_what_training_would(tmp_path, whole, capfd):
  env, demos = whole
  recording, out = tmp_path / "recording.npz", tmp_path / "mine.npz"
  wrong = _recording(env, demos)
  wrong["goal"][:, 0] += 0.1
  np.savez(recording, **wrong)
  command = ["convert", str(recording), "push_plate", str(out)]
  assert main.main(command) == 2
  assert "none of the 4 episodes is solved" in capfd.readouterr().err
  assert not out.exists()
  assert main.main([*command, "--allow-unsolved"]) == 0
  with pytest.raises(UserError, match="none of the 4 episodes"):
    demonstrations.load(out, env.task, env.config)
  # Objects out of the arm's reach.
  far = _recording(env, demos)
  far["plate"][:, 0] += 2.0
  far["goal"][:, 0] += 2.0
  np.savez(recording, **far)
  assert main.main([*command, "--overwrite"]) == 2
  assert "the arm cannot reach a primitive's target" in capfd.readouterr().err


def test_files_are_merged_and_unsolved_episodes_left_out(tmp_path, whole, demos, capfd):
  env, solved = whole
  some, all_of_them = tmp_path / "some.npz", tmp_path / "all.npz"
  both = demonstrations.join(demos, solved)
  demonstrations.save(some, both, task="push_plate", control_period_s=0.15)

  def counts(*options: str, code: int = 0) -> tuple[int, int]:
    command = ["convert", str(some), "push_plate", str(all_of_them), "--json"]
    assert main.main([*command, *options]) == code
    found = json.loads(capfd.readouterr().out) if not code else {}
    return found.get("demonstrations", 0), found.get("solved_demonstrations", 0)

  assert counts("--solved-only") == (4, 4)
  for a, b in zip(_load(all_of_them, env), solved, strict=True):
    np.testing.assert_array_equal(a, b)
  assert counts("--append") == (4 + EPISODES + 4, 8)
  joined = demonstrations.join(solved, both)
  for a, b in zip(_load(all_of_them, env), joined, strict=True):
    np.testing.assert_array_equal(a, b)
  before = all_of_them.read_bytes()
  counts("--append", "--overwrite", code=2)
  demonstrations.save(some, demos, task="push_plate", control_period_s=0.15)
  counts("--append", "--solved-only", "--allow-unsolved", code=2)
  assert "none of the 6 episodes is solved" in capfd.readouterr().err
  assert all_of_them.read_bytes() == before
  assert main.main(["convert", str(some), "push_plate", str(some), "--append"]) == 2
  assert "cannot be added to itself" in capfd.readouterr().err
