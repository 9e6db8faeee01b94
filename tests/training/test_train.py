"""A small but complete run: train, resume, evaluate, stop by a signal."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import importlib.metadata
import inspect
import json
import os
from pathlib import Path
import re
import shutil
import signal
from typing import Any

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.cli.evaluate import Evaluate
from apnpql_jax.config.ranges import (
  RandomizationConfig,
  check_sizes,
  validate_ranges,
)
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import Env
from apnpql_jax.errors import ConfigError, FileError, UserError
from apnpql_jax.primitives import reset_bank
from apnpql_jax.runs import checkpoint_reader, run_folder
from apnpql_jax.training import evaluate as evaluation, reporter
from apnpql_jax.training.evaluate import evaluate
from apnpql_jax.training.train import train
from apnpql_jax.training.video import HOLD

CONFIG = dataclasses.replace(
  testing.TINY,
  env=dataclasses.replace(testing.TINY.env, time_limit_s=0.75),
  eval_every=32,
  checkpoint_every=32,
  video=True,
)


def in_thread(function: Callable[[], dict]) -> dict:
  """Calls a function outside of the main thread, as servers and notebooks may do."""
  with ThreadPoolExecutor(1) as pool:
    return pool.submit(function).result()


@pytest.fixture(
  scope="module", params=["state", pytest.param("pixels", marks=pytest.mark.slow)]
)
def finished(request, tmp_path_factory) -> tuple[Path, dict]:
  """Returns the folder of a finished run and the result of ``train``."""
  run_dir = tmp_path_factory.mktemp("runs") / "run"
  env = dataclasses.replace(CONFIG.env, obs=request.param)
  config = dataclasses.replace(CONFIG, env=env)
  summary = in_thread(lambda: train(config, str(run_dir)))
  assert run_folder.open_run(run_dir).config == config
  return run_dir, summary


def changed(**settings: object) -> TrainConfig:
  return dataclasses.replace(testing.TINY, **settings)


@pytest.mark.parametrize(
  ("config", "options", "error", "words"),
  [
    (changed(rollout_length=3), {}, ConfigError, "replay.capacity=64 .* use 60"),
    (changed(sinks=("tape",)), {}, ConfigError, "'tape'"),
    (
      changed(replay=dataclasses.replace(testing.TINY.replay, demonstrations="none")),
      {},
      FileError,
      "cannot read none: No such file",
    ),
    (
      changed(env=dataclasses.replace(testing.TINY.env, control_period_s=0.151)),
      {},
      ConfigError,
      "control_period_s=0.151 must be a multiple of the scene's timestep",
    ),
    (testing.TINY, {"run_dir": "old"}, FileError, "old' holds a run"),
    (changed(seed=1), {"run_dir": "old", "resume": True}, ConfigError, "seed 0 -> 1"),
  ],
  ids=["settings", "sinks", "demonstrations", "timestep", "folder", "resume"],
)
def test_a_run_that_cannot_start_builds_and_writes_nothing(
  config, options, error, words, tmp_path, monkeypatch
):
  monkeypatch.chdir(tmp_path)
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # Of the banks.
  run_folder.create(Path("old"), testing.TINY)
  before = sorted(tmp_path.rglob("*"))
  with pytest.raises(error, match=words):
    train(config, **{"run_dir": "new"} | options)
  assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("resume", [False, True])
def test_a_second_start_in_one_folder_builds_nothing(tmp_path, monkeypatch, resume):
  """The first one has reserved the folder after the second one checked it."""
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # Of the banks.
  run = tmp_path / "run"
  if resume:
    run_folder.create(run, testing.TINY)
  monkeypatch.setattr(run_folder, "check_start", lambda *_, **__: None)
  with run_folder.reserve(run):
    with pytest.raises(FileError, match="is being trained by another process"):
      train(testing.TINY, run, resume=resume)
  assert run.exists() == resume and not (tmp_path / "cache").exists()


def test_a_run_without_room_for_a_checkpoint_is_refused(tmp_path, monkeypatch):
  """Before the replay is filled; the folder reserved for it is gone."""
  none = shutil.disk_usage(tmp_path)._replace(free=1000)
  monkeypatch.setattr(shutil, "disk_usage", lambda _: none)
  with pytest.raises(FileError, match="a checkpoint needs up to"):
    train(testing.TINY, tmp_path / "run")
  assert not any(tmp_path.iterdir())


def test_only_the_main_thread_can_be_asked_to_handle_signals(tmp_path):
  with pytest.raises(ConfigError, match="main thread"):
    in_thread(lambda: train(CONFIG, tmp_path / "run", handle_signals=True))


def test_a_run_writes_all_its_files(finished):
  run_dir, summary = finished
  assert summary["env_steps"] == 64 and summary["updates"] == 16
  assert summary["episodes"] == 4
  versions = json.loads((run_dir / "versions.json").read_text())
  assert versions["packages"]["mujoco"] == importlib.metadata.version("mujoco")
  lines = (run_dir / "metrics.jsonl").read_text().splitlines()
  rows = [json.loads(line) for line in lines]
  assert [row["step"] for row in rows if "loss/q" in row] == [*range(8, 72, 8)]
  assert [row["step"] for row in rows if "eval/success_rate" in row] == [32, 64]
  losses = [row["loss/q"] for row in rows if "loss/q" in row]
  assert np.isfinite(losses).all()
  assert checkpoint_reader.all_steps(run_dir) == [32, 64]
  assert iio.imread(run_dir / "curve.png").shape[-1] in (3, 4)
  (video,) = (run_dir / "videos").iterdir()
  frames = iio.imread(video, plugin="pyav")
  # Both cameras are next to the larger view, and something moves.
  assert frames.shape[0] > 10 and frames.shape[2] > 1.5 * frames.shape[1]
  assert np.abs(frames[0].astype(int) - frames[8]).max() > 50


def test_the_documents_explain_every_metric_of_a_run(finished):
  page = (testing.ROOT / "docs" / "diagnose.md").read_text()
  rows = re.findall(r"^\| (`.+?) \|", page.partition("## Metrics")[2], re.M)
  explained = re.findall(r"`(.+?)`", " ".join(rows))
  written = {name for row in testing.rows(finished[0]) for name in row}
  # This row of Table I has no parametric policy.
  assert sorted(explained) == sorted(written | {"grad_norm/policy", "loss/policy"})


def test_evaluate_reports_the_newest_checkpoint(finished, tmp_path):
  run_dir, _ = finished
  video = tmp_path / "videos" / "two.mp4"
  figures = evaluate(str(run_dir), episodes=2, seed=3, acting="mean", video=str(video))
  assert figures["checkpoint_step"] == 64
  assert figures["episodes"] == 2 and figures["acting"] == "mean"
  # All instants of both, the last of each held.
  frames = len(iio.imread(next(video.parent.iterdir()), plugin="pyav"))
  assert frames == 2 * (figures["mean_length"] + HOLD)
  assert figures["backend"] == "native" and figures["algorithm"] == "ap_npql"
  low, high = figures["ci95"]
  assert 0 <= low <= figures["success_rate"] <= high <= 1


def test_evaluate_plays_from_states_of_another_bank(finished, monkeypatch):
  make_env, played = evaluation.make_env, []

  def make(*args: Any, **options: Any) -> Env:
    env = make_env(*args, **options)
    played.append(np.asarray(env.begin(jnp.arange(3)).physics.qpos))
    return env

  monkeypatch.setattr(evaluation, "make_env", make)
  for seed in (reset_bank.SEED, 1, 1, 2):
    assert evaluate(finished[0], episodes=3, bank_seed=seed)["episodes"] == 3
  default, one, same, two = played
  np.testing.assert_array_equal(one, same)
  assert not np.array_equal(one, two) and not np.array_equal(one, default)


def test_a_checkpoint_is_read_before_the_run_may_remove_it(
  finished, tmp_path, monkeypatch
):
  """The worlds can take minutes, in which a run that is training saves others."""
  run = shutil.copytree(finished[0], tmp_path / "run")
  make_env = evaluation.make_env

  def make_slowly(*args: Any, **options: Any) -> Env:
    shutil.rmtree(run / "checkpoints" / "32")
    return make_env(*args, **options)

  monkeypatch.setattr(evaluation, "make_env", make_slowly)
  assert evaluation.load_trained(run, step=32).step == 32


@pytest.mark.parametrize(
  ("argument", "words"),
  [
    ({"bank_seed": -1}, "bank_seed=-1 must be from"),
    ({"episodes": 0}, "episodes=0 must be at least 1"),
    ({"seed": -1}, "seed=-1 must be from"),
    ({"backend": "bullet"}, "'bullet'; choose from auto"),
    ({"video": "x.avi"}, "x.avi must end in .mp4 or .gif"),
  ],
)
def test_evaluate_rejects_arguments_before_it_looks_for_checkpoints(
  argument, words, tmp_path
):
  run_folder.create(tmp_path / "run", CONFIG)
  with pytest.raises(ConfigError, match=words):
    evaluate(tmp_path / "run", **argument)


def test_evaluate_has_the_defaults_of_the_command_line():
  defaults = inspect.signature(evaluate).parameters
  for name in ("episodes", "seed", "backend", "acting", "bank_seed", "video"):
    assert defaults[name].default == getattr(Evaluate(), name)


def test_resume_continues_the_run(finished, monkeypatch, capsys):
  """Even if nothing can be drawn: what only reports must not cost a checkpoint."""

  def broken(*args: object, **settings: object) -> None:
    raise RuntimeError("no library")

  for name in ("plot_curve", "record_episodes"):
    monkeypatch.setattr(reporter, name, broken)
  run_dir, _ = finished
  config = run_folder.open_run(run_dir).config
  longer = dataclasses.replace(config, total_steps=96)
  summary = train(longer, run_dir, resume=True)
  assert summary["env_steps"] == 96 and summary["updates"] == 24
  assert checkpoint_reader.latest_step(run_dir) == 96
  shown = capsys.readouterr().err
  for report in ("draw the curve", "write the video"):
    assert shown.count(f"cannot {report}: no library") == 1
  rows = (run_dir / "metrics.jsonl").read_text().splitlines()
  steps = [json.loads(row)["step"] for row in rows if "loss/q" in row]
  assert steps == [*range(8, 104, 8)]


def test_a_signal_in_the_last_iteration_costs_no_evaluation(tmp_path, monkeypatch):
  report = reporter.Reporter.iteration

  def report_and_stop(*args: Any) -> None:
    report(*args)
    os.kill(os.getpid(), signal.SIGTERM)

  monkeypatch.setattr(reporter.Reporter, "iteration", report_and_stop)
  run_dir = tmp_path / "run"
  summary = train(changed(total_steps=testing.STEPS), run_dir, handle_signals=True)
  assert (summary["env_steps"], summary["episodes"]) == (testing.STEPS, 4)
  (row,) = (row for row in testing.rows(run_dir) if "eval/episodes" in row)
  assert row["step"] == checkpoint_reader.best_step(run_dir) == testing.STEPS


def test_resume_rejects_other_settings(finished):
  run_dir, _ = finished
  config = run_folder.open_run(run_dir).config
  other = dataclasses.replace(
    config, agent=dataclasses.replace(config.agent, gamma=0.9)
  )
  with pytest.raises(UserError, match=r"agent\.gamma 0\.99 -> 0\.9"):
    train(other, run_dir, resume=True)


@pytest.mark.parametrize(
  ("sizes", "fits"),
  [
    ({"size": 0.07, "shape": 0.02}, True),
    ({"size": 0.0, "shape": 0.09}, True),
    ({"size": 0.08, "shape": 0.0}, False),
    ({"size": 0.06, "shape": 0.04}, False),
  ],
)
def test_a_new_run_refuses_sizes_at_which_stack_box_fails(sizes, fits: bool, tmp_path):
  ranges = RandomizationConfig(**sizes)
  validate_ranges(ranges, "")  # Older runs with them can still be used.
  if fits:
    check_sizes(ranges)
    return
  env = dataclasses.replace(testing.TINY.env, randomization=ranges)
  with pytest.raises(ConfigError, match=r"size=.* at most 0\.07, .* at most 0\.09"):
    train(dataclasses.replace(testing.TINY, env=env), tmp_path / "run")
  assert not (tmp_path / "run").exists()
