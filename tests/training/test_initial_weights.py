"""New runs that start with the weights of another one."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import json
from pathlib import Path
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.agents.table_one import ALGORITHMS
from apnpql_jax.cli.main import main
from apnpql_jax.config import changes, codec
from apnpql_jax.config.schema import AgentConfig, EnvConfig, TrainConfig
from apnpql_jax.envs.env import observation_shapes
from apnpql_jax.errors import ConfigError, FileError
from apnpql_jax.runs import checkpoint_reader, provenance, run_folder
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.tasks import make_task
from apnpql_jax.training import initial_weights
from apnpql_jax.training.train import train

PIXELS = TrainConfig(
  env=EnvConfig(global_size=(24, 32), wrist_size=(16, 16)), agent=testing.SMALL
)


def learner_of(config: TrainConfig, seed: int = 0) -> Any:
  task, lstm_instants = make_task(config.env.task), config.agent.lstm_instants
  shapes = observation_shapes(config.env, task, lstm_instants=lstm_instants)
  zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
  return make_agent(config.agent).init(jax.random.key(seed), zeros)


def write_run(path: Path, config: TrainConfig, **rates: float) -> Path:
  """Writes a run with a checkpoint per success rate, of seed and step 1, 2, ..."""
  run = run_folder.create(path, config).path
  with CheckpointWriter(run, config, keep=9) as writer:
    for step, rate in enumerate(rates.values(), 1):
      items = {"learner": learner_of(config, seed=step)}
      writer.save(step, items, success_rate=rate)
  return run


def changed(config: TrainConfig, part: str, **settings: Any) -> TrainConfig:
  new = dataclasses.replace(getattr(config, part), **settings)
  return dataclasses.replace(config, **{part: new})


def paths_of(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
  """Yields path and leaf of nested dicts, without the project's own code."""
  if not isinstance(tree, dict):
    yield path[1:], tree
    return
  for name, part in tree.items():
    yield from paths_of(part, f"{path}/{name}")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
  path = tmp_path_factory.mktemp("runs") / "a:1"
  return write_run(path, PIXELS, first=0.5, second=0.75, third=0.25)


@pytest.mark.parametrize(("suffix", "step"), [("", 3), (":1", 1), (":best", 2)])
def test_the_weights_of_a_checkpoint_are_read(run, suffix, step):
  """For another task, other worlds, and other settings of the learning."""
  config = changed(PIXELS, "env", task="stack_box", worlds=4, randomize=True)
  agent = {"learning_rate_e": 1e-5, "decay_updates": 7, "policy_samples": 9}
  config = changed(config, "agent", **agent)
  initial_weights.check(f"{run}{suffix}", config)
  weights = initial_weights.load(f"{run}{suffix}", config, None)
  learner = learner_of(PIXELS, seed=step)
  expected = {"params": learner.params, "target_params": learner.target_params}
  flat = dict(paths_of(expected))
  assert flat.keys() == weights.arrays.keys() and len(flat) > 20
  for path, array in weights.arrays.items():
    np.testing.assert_array_equal(array, flat[path])
  assert weights.origin["run"] == str(run) and weights.origin["step"] == step
  other = initial_weights.load(f"{run}:{step % 3 + 1}", config, None)
  assert other.origin["sha256"] != weights.origin["sha256"]


@pytest.mark.parametrize("suffix", ["", ":best", ":1"])
def test_a_checkpoint_that_the_run_replaces_meanwhile_leads_to_the_newer_one(
  tmp_path, suffix
):
  run = write_run(tmp_path / "run", PIXELS, first=0.5)
  initial_weights.check(f"{run}{suffix}", PIXELS)
  with CheckpointWriter(run, PIXELS, keep=1) as writer:
    writer.save(2, {"learner": learner_of(PIXELS, seed=2)}, success_rate=0.75)
  assert checkpoint_reader.all_steps(run) == [2]
  if suffix == ":1":
    with pytest.raises(FileError, match="has no checkpoint 1; choose from 2$"):
      initial_weights.load(f"{run}{suffix}", PIXELS, None)
    return
  weights = initial_weights.load(f"{run}{suffix}", PIXELS, None)
  assert weights.origin["step"] == 2
  expected = learner_of(PIXELS, seed=2)
  for path, leaf in paths_of({"params": expected.params}):
    np.testing.assert_array_equal(weights.arrays[path], leaf)


@pytest.mark.parametrize(
  ("part", "settings", "words"),
  [
    ("agent", {"hidden": (8, 8)}, r"agent.hidden \(16, 16\) -> \(8, 8\)$"),
    (
      "agent",
      {"feature_dim": 8, "num_atoms": 13, "gamma": 0.9},
      "fit: agent.num_atoms 11 -> 13, agent.feature_dim 16 -> 8$",
    ),
    ("agent", {"algorithm": "sac"}, "fit: agent.algorithm ap_npql -> sac$"),
    ("env", {"obs": "state", "task": "stack_box"}, "fit: env.obs pixels -> state$"),
    ("env", {"wrist_size": (32, 32)}, "fit: env.wrist_size"),
  ],
)
def test_weights_that_do_not_fit_are_refused_by_setting(run, part, settings, words):
  with pytest.raises(ConfigError, match=words):
    initial_weights.check(run, changed(PIXELS, part, **settings))


def test_weights_of_another_task_with_other_points_are_refused(tmp_path):
  config = changed(PIXELS, "env", obs="state")
  run = write_run(tmp_path / "run", config, only=0.0)
  with pytest.raises(ConfigError, match="fit: env.task push_plate -> flip_cup$"):
    initial_weights.check(run, changed(config, "env", task="flip_cup"))


@pytest.mark.parametrize(
  ("origin", "words"),
  [
    ("{}:7", "no checkpoint 7; choose from 1, 2, 3"),
    ("{}:newest", "a:1:newest' is not a run folder"),
    ("{}x", "a:1x' is not a run folder"),
    ("nowhere:3", "'nowhere' is not a run folder"),
  ],
)
def test_an_origin_that_is_not_there_is_refused(run, origin, words):
  with pytest.raises(FileError, match=words):
    initial_weights.check(origin.format(run), PIXELS)


def test_settings_of_weights_are_all_that_change_their_shapes():
  base = dataclasses.replace(testing.SMALL, residual_blocks=1, gripper_offset=True)

  def kinds(config: AgentConfig, env: EnvConfig = PIXELS.env) -> Any:
    whole = dataclasses.replace(PIXELS, agent=config, env=env)
    return jax.tree.map(jnp.shape, jax.eval_shape(lambda: learner_of(whole).params))

  others = {
    "algorithm": tuple(ALGORITHMS),
    "candidate_precision": ("bfloat16",),
    "temperature": ("shared", "fixed"),
    "alpha_floor": ("clip",),
    "regularizer": ("uniform",),
    "policy_evaluation": ("td0", "clipped_double_q"),
    "prior_mean": ("learned",),
    "global_features": ("keypoints", "both"),
    "wrist_features": ("keypoints", "both"),
    "hidden": ((8, 16), (16, 16, 16)),
    "lstm_instants": (2,),
    "v_max": (2.0,),
  }
  expected = kinds(base)
  for name, value in codec.flatten(base):
    step = (lambda x: not x) if isinstance(value, bool) else (lambda x: x * 1.01)
    step = (lambda x: x + 1) if type(value) is int else step
    for other in others[name] if name in others else (step(value),):
      found = kinds(dataclasses.replace(base, **{name: other}))
      assert found == expected or f"agent.{name}" in changes.OF_WEIGHTS, name


def test_a_run_continues_from_the_weights_of_a_run_that_is_gone(tmp_path, capsys):
  """Also if it is killed before its first checkpoint."""
  first = write_run(tmp_path / "first", testing.TINY, a=0.0)
  ends = learner_of(testing.TINY, seed=1)
  # So slow that the weights stay.
  still = {f"learning_rate_{x}": 1e-12 for x in ("e", "m", "alpha", "nu")}
  config = changed(testing.TINY, "agent", **still, target_rate=1e-6)
  config = changed(config, "env", worlds=8)
  config = dataclasses.replace(config, total_steps=16)
  run = tmp_path / "run"
  train(config, run, init_from=first)
  assert f"weights of {first}, step 1" in capsys.readouterr().err
  shutil.rmtree(first)
  origin = json.loads((run / "versions.json").read_text())["origin"]
  assert (origin["run"], origin["step"]) == (str(first), 1)
  assert len(origin["sha256"]) == 64 and provenance.changed_versions(run) == []
  wanted = {"learner": {"params": ends.params, "target_params": ends.target_params}}
  found = checkpoint_reader.restore(run, 16, wanted, partly=True).items
  for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-7)

  whole = testing.saved_bytes(run, 16)
  for name in ("checkpoints", "segments"):
    shutil.rmtree(run / name)
  train(config, run, resume=True)
  assert testing.saved_bytes(run, 16) == whole
  for name in ("checkpoints", "segments"):
    shutil.rmtree(run / name)
  path = run / initial_weights.FILE
  arrays = dict(np.load(path))
  arrays["params/ap/Dense_0/bias"] = arrays["params/ap/Dense_0/bias"] + 1
  np.savez(path, **arrays)
  with pytest.raises(FileError, match="is not what versions.json describes"):
    train(config, run, resume=True)
  path.unlink()
  with pytest.raises(FileError, match="initial_weights.npz"):
    train(config, run, resume=True)


def test_the_command_line_refuses_an_origin_that_does_not_fit(run, tmp_path, capsys):
  new = ["train", "push_plate", "--run", str(tmp_path / "new")]
  assert main([*new, "--init-from", str(run)]) == 2
  assert "do not fit: agent." in capsys.readouterr().err
  assert main(["train", "--resume", str(run), "--init-from", str(run)]) == 2
  assert "leave out --init-from" in capsys.readouterr().err
  assert main([*new, "--init-from", f"{run}/checkpoints/1"]) == 2
  assert "is not a run folder" in capsys.readouterr().err
  assert not (tmp_path / "new").exists()
