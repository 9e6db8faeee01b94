"""Run folders: nothing is lost unless it was asked for."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import json
import os
from pathlib import Path
import resource
import shutil
import subprocess
import sys
import time
from typing import Any

import pytest

from apnpql_jax.config import changes, codec
from apnpql_jax.config.files import config_to_json
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.errors import ConfigError, UserError
from apnpql_jax.runs import provenance, run_folder

ROOT = Path(__file__).resolve().parents[2]


def write_run(folder: Path, config: TrainConfig | None = None) -> Path:
  folder.mkdir(parents=True)
  (folder / "config.json").write_text(config_to_json(config or TrainConfig()))
  (folder / "curve.png").write_bytes(b"old")
  return folder


def test_new_run_dir_makes_the_first_free_number(tmp_path):
  root = tmp_path / "runs"
  (root / "push_plate-1").mkdir(parents=True)
  (root / "push_plate-3").mkdir()
  with run_folder.new_run_dir("push_plate", root) as second:
    with run_folder.new_run_dir("push_plate", root) as fourth:
      assert [second.name, fourth.name] == ["push_plate-2", "push_plate-4"]
      run_folder.create(fourth, TrainConfig())
  left = {path.name for path in root.iterdir()}
  assert left == {"push_plate-1", "push_plate-3", "push_plate-4"}


def test_two_runs_started_together_take_two_folders(tmp_path):
  """Before anything is built: both are killed as soon as they have chosen."""
  command = [sys.executable, "-m", "apnpql_jax", "train", "push_plate"]
  env = os.environ | {"PYTHONPATH": str(ROOT)}
  processes = [subprocess.Popen(command, cwd=tmp_path, env=env) for _ in range(2)]
  folders = [tmp_path / "runs" / f"push_plate-{n}" for n in (1, 2)]
  deadline = time.monotonic() + 60
  while not all(folder.exists() for folder in folders):
    assert time.monotonic() < deadline
    time.sleep(0.01)
  for process in processes:
    process.kill()
    process.wait()
  assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_a_reserved_folder_is_refused_and_removed_if_unused(tmp_path):
  run = tmp_path / "run"
  with run_folder.reserve(run):
    with pytest.raises(UserError, match="another process"):
      run_folder.check_free(run, overwrite=False)
    with pytest.raises(UserError, match="another process"):
      run_folder.reserve(run).__enter__()
  assert not run.exists()
  with run_folder.reserve(run):
    run_folder.create(run, TrainConfig())
  with run_folder.reserve(run), pytest.raises(UserError, match="another process"):
    run_folder.check_resumable(run, TrainConfig())
  assert run_folder.load_run_config(run) == TrainConfig()


def test_configuration_of_a_run_is_read_back(tmp_path):
  config = TrainConfig(seed=3, agent=AgentConfig(gamma=0.9))
  assert run_folder.load_run_config(write_run(tmp_path / "a", config)) == config


def test_a_run_older_than_a_setting_is_read_with_a_warning(tmp_path):
  config = TrainConfig(seed=3, agent=AgentConfig(gamma=0.9))
  run = write_run(tmp_path / "a", config)
  data = json.loads((run / "config.json").read_text())
  del data["agent"]["residual_blocks"]
  (run / "config.json").write_text(json.dumps(data))
  warnings: list[str] = []
  assert run_folder.load_run_config(run, warnings.append) == config
  assert warnings == [
    f"{run}/config.json is older than some settings, which keep their old behavior: "
    "agent.residual_blocks 0"
  ]
  # It is resumed as it was, and only so.
  run_folder.check_resumable(run, config)
  blocks = dataclasses.replace(config.agent, residual_blocks=1)
  with pytest.raises(UserError, match="agent.residual_blocks 0 -> 1"):
    run_folder.check_resumable(run, dataclasses.replace(config, agent=blocks))
  del data["agent"]["n_step"]
  (run / "config.json").write_text(json.dumps(data))
  with pytest.raises(UserError, match="config.json: .*'agent.n_step' is missing"):
    run_folder.load_run_config(run, pytest.fail)


def test_configuration_that_is_not_text_is_refused(tmp_path):
  write_run(tmp_path / "a")
  (tmp_path / "a" / "config.json").write_bytes(b"\xff\xfe\x00")
  with pytest.raises(UserError, match="config.json"):
    run_folder.load_run_config(tmp_path / "a")


def changed(config: Any, name: str) -> Any:
  """Returns the configuration with another value of the setting ``name``."""
  name, _, rest = name.partition(".")
  value = getattr(config, name)
  kinds: dict[type, Callable[[Any], Any]] = {
    bool: lambda x: not x,
    int: lambda x: x + 1,
    float: lambda x: x + 0.01,
    str: lambda x: x + "a",
    tuple: lambda x: (*x, 1),
  }
  value = changed(value, rest) if rest else kinds[type(value)](value)
  return dataclasses.replace(config, **{name: value})


def test_resume_changes_only_declared_settings(tmp_path):
  run, names = write_run(tmp_path / "a"), dict(codec.flatten(TrainConfig()))
  assert names.keys() >= {*changes.MAY_CHANGE, *changes.OF_WEIGHTS}
  for name in names:
    other = changed(TrainConfig(), name)
    if name in changes.MAY_CHANGE:
      run_folder.check_resumable(run, other)
      continue
    with pytest.raises(ConfigError, match=f"{name} .*start a new run") as error:
      run_folder.check_resumable(run, other)
    assert ("--init-from" in str(error.value)) == (name not in changes.OF_WEIGHTS)


def test_settings_that_change_at_a_resume_are_recorded(tmp_path):
  config = TrainConfig(seed=3)
  run = run_folder.create(tmp_path / "run", config).path
  assert run_folder.change(run, config, step=16) == ""
  assert "changes" not in (provenance.read(run) or {})
  for step, name in (16, "agent.epsilon"), (32, "total_steps"):
    config = changed(config, name)
    assert run_folder.change(run, config, step=step).startswith(name)
    assert run_folder.load_run_config(run) == config
  found = (provenance.read(run) or {})["changes"]
  assert [(x["step"], x["settings"]) for x in found] == [
    (16, {"agent.epsilon": [1.0, 1.01]}),
    (32, {"total_steps": [200_000, 200_001]}),
  ]
  assert provenance.changed_versions(run) == []


def test_only_the_file_of_a_task_can_have_changed(tmp_path):
  file = tmp_path / "mine.py"
  file.write_text("task = 1")
  config = TrainConfig()
  preset_only = run_folder.create(tmp_path / "preset", config).path
  with_task = dataclasses.replace(config.env, task_file=str(file))
  run = run_folder.create(
    tmp_path / "task", dataclasses.replace(config, env=with_task)
  ).path
  assert not provenance.changed_task(run, file)
  file.write_text("task = 2")
  assert provenance.changed_task(run, file)
  assert not provenance.changed_task(preset_only, file)


def test_a_run_in_training_is_not_replaced(tmp_path):
  run, other = write_run(tmp_path / "run"), write_run(tmp_path / "other")
  with run_folder.lock(run), run_folder.lock(other):
    for refused in (
      lambda: run_folder.check_resumable(run, TrainConfig()),
      lambda: run_folder.check_free(run, overwrite=True),
      lambda: run_folder.lock(run).__enter__(),
    ):
      with pytest.raises(UserError, match="run' is being trained by another process"):
        refused()
    run_folder.load_run_config(run)
  run_folder.check_resumable(run, TrainConfig())
  run_folder.check_free(run, overwrite=True)
  # A process that is killed lets go of it.
  code = "import sys, pathlib, time; from apnpql_jax.runs import run_folder\n"
  code += (
    "with run_folder.lock(pathlib.Path(sys.argv[1])): print(flush=True); time.sleep(60)"
  )
  command = [sys.executable, "-c", code, str(run)]
  with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
    assert process.stdout is not None and process.stdout.readline()
    with pytest.raises(UserError, match="another process"):
      run_folder.check_free(run, overwrite=True)
    process.kill()
  run_folder.check_free(run, overwrite=True)


def test_a_disk_without_room_for_a_checkpoint_is_refused(tmp_path):
  free = shutil.disk_usage(tmp_path).free
  run = tmp_path / "deep" / "run"
  assert run_folder.check_disk(run, free // 100, free // 50) == ""
  warning = run_folder.check_disk(run, free // 2, 2 * free)
  assert "checkpoints that are kept need" in warning and "keep_checkpoints" in warning
  with pytest.raises(UserError, match="a checkpoint needs up to .* replay.capacity"):
    run_folder.check_disk(run, 2 * free, 3 * free)


def test_only_a_run_can_be_overwritten(tmp_path):
  run_folder.check_free(tmp_path / "new", overwrite=False)
  (tmp_path / "empty").mkdir()
  run_folder.check_free(tmp_path / "empty", overwrite=False)
  run = write_run(tmp_path / "run")
  run_folder.check_free(run, overwrite=True)
  with pytest.raises(UserError, match="--overwrite"):
    run_folder.check_free(run, overwrite=False)
  (tmp_path / "link").symlink_to(run, target_is_directory=True)
  (run / "config.json").rename(tmp_path / "elsewhere.json")
  for folder in (run, tmp_path, tmp_path / "link", tmp_path / "elsewhere.json"):
    with pytest.raises(UserError):
      run_folder.check_free(folder, overwrite=True)


def test_new_run_replaces_the_old_one(tmp_path):
  run = write_run(tmp_path / "run")
  run_folder.create(run, TrainConfig(seed=4), overwrite=True)
  assert [path.name for path in tmp_path.iterdir()] == ["run"]
  assert {path.name for path in run.iterdir()} == {"config.json", "versions.json"}
  assert run_folder.load_run_config(run) == TrainConfig(seed=4)


@pytest.mark.parametrize("existed", [False, True])
def test_run_that_cannot_be_written_leaves_everything_as_it_was(tmp_path, existed):
  run = tmp_path / "run"
  if existed:
    write_run(run)
  soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
  resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 10, hard))  # As on a full disk.
  try:
    with pytest.raises(UserError, match="cannot make run folder .*large"):
      run_folder.create(run, TrainConfig(seed=4), overwrite=True)
  finally:
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
  assert [path.name for path in tmp_path.iterdir()] == (["run"] if existed else [])
  if existed:
    assert (run / "curve.png").read_bytes() == b"old"
    assert run_folder.load_run_config(run) == TrainConfig()


KILLED = """
import os, pathlib, sys
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.runs import run_folder

def end(event, args):
  moved = event == "os.rename" and str(args[0]) == sys.argv[1]
  if moved or event == "shutil.rmtree":
    os._exit(9)

sys.addaudithook(end)
run_folder.create(pathlib.Path(sys.argv[1]), TrainConfig(seed=4), overwrite=True)
"""


def test_process_killed_before_it_replaces_a_run_leaves_that_run_intact(tmp_path):
  run = write_run(tmp_path / "run")
  command = [sys.executable, "-c", KILLED, str(run)]
  assert subprocess.run(command, cwd=ROOT, timeout=60).returncode == 9
  assert (run / "curve.png").read_bytes() == b"old"
  assert run_folder.load_run_config(run) == TrainConfig()


def test_folder_that_cannot_be_made_is_refused(tmp_path):
  (tmp_path / "file").write_text("")
  with pytest.raises(UserError, match="cannot make run folder"):
    run_folder.create(tmp_path / "file" / "run", TrainConfig())
