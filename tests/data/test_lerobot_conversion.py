"""Datasets of LeRobot from the scripted expert, and back to demonstrations."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.cli import main
from apnpql_jax.data import demonstrations, lerobot
from apnpql_jax.data.demonstrations import Demonstrations
from apnpql_jax.data.lerobot import conversion
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.errors import UserError
from apnpql_jax.sim.names import ARM_JOINTS
from apnpql_jax.training import expert
from apnpql_jax.training.expert_dataset import write_dataset

pytest.importorskip("pyarrow.parquet")

ENV = dataclasses.replace(testing.TINY.env, time_limit_s=0.9)


@pytest.fixture(scope="module")
def env() -> Env:
  return make_env(ENV)


@pytest.fixture(scope="module")
def demos(env) -> Demonstrations:
  return expert.record_expert(env, episodes=3, seed=0, noise=0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, env, demos) -> Path:
  folder = tmp_path_factory.mktemp("expert") / "dataset"
  counts = write_dataset(folder, demos, env.task, env.config)
  assert counts["demonstrations"] == 3 and counts["instants"] == demos.instants
  return folder


def _convert(folder: Path, env: Env) -> Demonstrations:
  return conversion.convert(folder, env.task.scene, period_s=0.15)


def test_a_dataset_of_the_expert_is_its_demonstrations(env, demos, folder):
  """To the last bit."""
  for a, b in zip(_convert(folder, env), demos, strict=True):
    assert a.dtype == b.dtype
    np.testing.assert_array_equal(a, b)


def test_a_dataset_of_the_expert_has_what_the_agent_sees(env, demos, folder):
  scene = env.task.scene
  dataset = lerobot.read(folder)
  joints = np.concatenate([x.joints for x in dataset.episodes])
  np.testing.assert_array_equal(joints, demos.qpos[:, scene.arm_qpos])
  assert dataset.names[lerobot.STATE] == [*ARM_JOINTS, "finger_r1"]
  names = dataset.names[lerobot.ENVIRONMENT]
  where = [names.index(f"plate.{x}") for x in ("x", "y", "z")]
  address, _ = scene.free_joint("plate")
  plate = dataset.episodes[0].columns[lerobot.ENVIRONMENT][:, where]
  count = len(plate)
  np.testing.assert_array_equal(plate, demos.qpos[:count, address : address + 3])
  begin = 0
  for episode in dataset.episodes:
    state = demos.rows(np.arange(begin, begin + len(episode.time))).states(scene)
    for name in ("global", "wrist"):
      images = np.stack([*episode.images(f"{lerobot.IMAGES}{name}")])
      drawn = np.asarray(env.view(_camera(env, name), state))
      assert images.shape == drawn.shape
      assert abs(images.astype(int) - drawn).mean() < 3
    begin += len(episode.time)


def _camera(env: Env, name: str):
  from apnpql_jax.envs.cameras import camera_renderer

  size = getattr(env.config, f"{name}_size")
  return camera_renderer(env.config, env.task.scene, name, size)


def _rewrite(
  source: Path, target: Path, keep: list[str] | None, fps: float = 1 / 0.15
) -> Path:
  """Copies a dataset without images, with some names of the state, or without it."""
  dataset = lerobot.read(source)
  vectors = {name: dataset.names[name] for name in (lerobot.STATE, lerobot.ACTION)}
  if keep is not None:
    vectors[lerobot.ENVIRONMENT] = keep
    index = [dataset.names[lerobot.ENVIRONMENT].index(name) for name in keep]
  with lerobot.Writer(target, fps=fps, vectors=vectors, robot_type="arm") as writer:
    for episode in dataset.episodes:
      for i in range(len(episode.time)):
        frame = {name: episode.columns[name][i] for name in vectors}
        if keep is not None:
          frame[lerobot.ENVIRONMENT] = frame[lerobot.ENVIRONMENT][index]
        writer.add(frame)
      writer.end_episode(episode.task, episode.success)
  return target


def test_poses_suffice_as_in_a_recording(tmp_path, env, demos, folder):
  """Velocities and actions then come from the motion."""
  names = lerobot.read(folder).names[lerobot.ENVIRONMENT]
  poses = [
    name
    for name in names
    if name.startswith(("plate.", "goal.")) and ".v" not in name and ".w" not in name
  ]
  assert len(poses) == 14
  made = _convert(_rewrite(folder, tmp_path / "poses", poses), env)
  np.testing.assert_array_equal(made.first, demos.first)
  arm = env.task.scene.arm_qpos
  np.testing.assert_allclose(made.qpos[:, arm], demos.qpos[:, arm], atol=1e-5)
  np.testing.assert_allclose(made.mocap_pos, demos.mocap_pos, atol=1e-6)
  address, _ = env.task.scene.free_joint("plate")
  plate = slice(address, address + 7)
  np.testing.assert_allclose(made.qpos[:, plate], demos.qpos[:, plate], atol=1e-5)
  moved = np.diff(made.qpos[:, arm], axis=0)[~made.first[1:]]
  driven = made.action[:-1, :6][~made.first[1:]]
  assert np.corrcoef(moved.ravel(), driven.ravel())[0, 1] > 0.5


def test_what_cannot_be_converted_is_named(tmp_path, env, folder):
  def refused(target: Path, match: str) -> None:
    with pytest.raises(UserError, match=match) as caught:
      _convert(target, env)
    assert str(target) in str(caught.value)

  refused(
    _rewrite(folder, tmp_path / "none", None),
    "has no observation.environment_state, the poses of the objects",
  )
  names = [f"plate.{x}" for x in ("x", "y", "z", "qw", "qx", "qy", "qz")]
  refused(_rewrite(folder, tmp_path / "some", names), "lacks the poses of goal")
  odd = _rewrite(folder, tmp_path / "odd", names)
  info = json.loads((odd / "meta/info.json").read_text())
  info["features"][lerobot.ENVIRONMENT]["names"] = [[name] for name in names]
  (odd / "meta/info.json").write_text(json.dumps(info))
  refused(odd, "lacks the poses of")
  whole = conversion.state_names(env.task.scene)
  fast = _rewrite(folder, tmp_path / "fast", whole, fps=30)
  refused(fast, "frames are 0.0333.* s apart, not 0.15 s")
  empty = lerobot.Writer(
    tmp_path / "empty",
    fps=10,
    vectors={lerobot.STATE: list("abcdefg"), lerobot.ACTION: list("abcdefg")},
    robot_type="arm",
  )
  empty.close()
  refused(tmp_path / "empty", "has no episodes")


def test_options_that_do_not_fit_are_refused(tmp_path, capfd):
  def refused(match: str, *options: str) -> None:
    assert main.main(["collect", "push_plate", *options]) == 2
    assert match in capfd.readouterr().err

  (tmp_path / "full").mkdir()
  (tmp_path / "full" / "file").touch()
  refused("unknown --format 'csv'", "--format", "csv")
  refused("need --save", "--format", "lerobot")
  lerobot_options = ("--format", "lerobot", "--save")
  refused("exists; name a new folder", *lerobot_options, str(tmp_path / "full"))
  refused(
    "--append needs --format npz", *lerobot_options, str(tmp_path / "x"), "--append"
  )


@pytest.mark.slow
def test_the_commands_agree(tmp_path, capfd):
  """The same seeds give the same demonstrations by both ways."""
  direct, folder, made = (tmp_path / x for x in ("direct.npz", "dataset", "made.npz"))
  common = ["collect", "push_plate", "--episodes", "2", "--seed", "3", "--json"]
  assert main.main([*common, "--save", str(direct)]) == 0
  assert main.main([*common, "--save", str(folder), "--format", "lerobot"]) == 0
  counts = json.loads(capfd.readouterr().out.splitlines()[-1])
  assert counts["demonstrations"] == counts["solved_demonstrations"] == 2
  assert main.main(["convert", str(folder), "push_plate", str(made)]) == 0
  with np.load(direct) as a, np.load(made) as b:
    assert set(a) == set(b)
    for name in Demonstrations._fields:
      np.testing.assert_array_equal(a[name], b[name])
  assert demonstrations.is_demonstrations(made)
