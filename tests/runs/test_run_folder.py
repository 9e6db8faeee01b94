"""Run folders on a real file system."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
import platform
import shutil
import subprocess
import sys

import jax
import pytest

from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.errors import UserError
from apnpql_jax.reports import reading
from apnpql_jax.runs import provenance, run_folder, text
from apnpql_jax.runs.provenance import changed_versions

CONFIG = TrainConfig(env=EnvConfig(worlds=64), seed=3)


def test_a_new_run_is_opened_with_the_same_configuration(tmp_path: Path):
  made = run_folder.create(tmp_path / "deep" / "run", CONFIG)
  opened = run_folder.open_run(tmp_path / "deep" / "run")
  assert opened == made and opened.config == CONFIG
  names = {path.name for path in made.path.iterdir()}
  assert names == {"config.json", "versions.json"}


def test_versions_describe_the_start_of_a_run(tmp_path: Path):
  folder = run_folder.create(tmp_path / "run", CONFIG)
  versions = json.loads((folder.path / "versions.json").read_text())
  assert versions["python"] == platform.python_version()
  assert versions["packages"]["jax"] == jax.__version__
  assert versions["device"]["backend"] == jax.default_backend()
  assert versions["device"]["count"] == jax.device_count()


def test_git_commit_is_that_of_the_package_only(tmp_path: Path):
  def git(*args: str) -> str:
    identity = ["-c", "user.name=t", "-c", "user.email=t@t"]
    command = ["git", "-C", str(tmp_path), *identity, *args]
    return subprocess.run(
      command, check=True, capture_output=True, text=True
    ).stdout.strip()

  package = tmp_path / "package"
  package.mkdir()
  (package / "__init__.py").write_text("a = 1\n")
  assert provenance._git(package) is None
  git("init", "-q")
  # Installed inside a repository that does not track it.
  git("commit", "-q", "--allow-empty", "-m", "other")
  assert provenance._git(package) is None
  git("add", "package")
  git("commit", "-q", "-m", "mine")
  commit = git("rev-parse", "HEAD")
  assert provenance._git(package) == {"commit": commit, "dirty": False}
  (package / "__init__.py").write_text("a = 2\n")
  assert provenance._git(package) == {"commit": commit, "dirty": True}


def test_changed_versions_are_listed(tmp_path: Path):
  folder = run_folder.create(tmp_path / "run", CONFIG)
  assert changed_versions(folder.path) == []
  versions = json.loads((folder.path / "versions.json").read_text())
  versions["packages"]["jax"] = "0.0.1"
  versions["created"] = "long ago"
  (folder.path / "versions.json").write_text(json.dumps(versions))
  assert changed_versions(folder.path) == [f"jax 0.0.1 -> {jax.__version__}"]
  (folder.path / "versions.json").write_text("{")
  assert changed_versions(folder.path) == ["versions.json cannot be read"]


def test_another_number_of_devices_is_a_changed_version(tmp_path: Path):
  folder = run_folder.create(tmp_path / "run", CONFIG, devices=2)
  assert changed_versions(folder.path, devices=2) == []
  assert changed_versions(folder.path, devices=4) == ["count 2 -> 4"]


def test_a_run_is_replaced_only_when_asked(tmp_path: Path):
  run = tmp_path / "run"
  run_folder.create(run, CONFIG)
  (run / "metrics.jsonl").write_text('{"step": 1}\n')
  other = dataclasses.replace(CONFIG, seed=4)
  with pytest.raises(UserError, match="holds a run") as error:
    run_folder.create(run, other)
  assert "\n" not in str(error.value)
  assert run_folder.open_run(run).config == CONFIG and (run / "metrics.jsonl").exists()
  run_folder.create(run, other, overwrite=True)
  assert run_folder.open_run(run).config == other
  assert not (run / "metrics.jsonl").exists()
  assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_replaced_run_that_could_not_be_removed_is_no_run(tmp_path, monkeypatch):
  run_folder.create(tmp_path / "run", CONFIG)
  monkeypatch.setattr(shutil, "rmtree", lambda *args, **options: None)
  run_folder.create(tmp_path / "run", CONFIG, overwrite=True)
  assert len([*tmp_path.iterdir()]) == 2
  assert [run.name for run in reading.find([tmp_path])] == ["run"]


def test_a_folder_other_than_a_run_is_never_removed(tmp_path: Path):
  thesis = tmp_path / "thesis.txt"
  thesis.write_text("years of work")
  for overwrite in (False, True):
    with pytest.raises(UserError, match="not a run"):
      run_folder.create(tmp_path, CONFIG, overwrite=overwrite)
  with pytest.raises(UserError, match="not a folder"):
    run_folder.create(thesis, CONFIG, overwrite=True)
  assert thesis.read_text() == "years of work"
  empty = tmp_path / "empty"
  empty.mkdir()
  assert run_folder.create(empty, CONFIG).config == CONFIG


def test_only_a_run_folder_is_opened(tmp_path: Path):
  for path in (tmp_path, tmp_path / "missing"):
    with pytest.raises(UserError, match="not a run folder") as error:
      run_folder.open_run(path)
    assert "\n" not in str(error.value)
  folder = run_folder.create(tmp_path / "run", CONFIG)
  (folder.path / "config.json").write_text('{"seed": 1}')
  with pytest.raises(UserError, match=r"config.json: .*missing"):
    run_folder.open_run(folder.path)


def test_a_text_file_is_written_whole_or_not_at_all(tmp_path: Path):
  path = tmp_path / "a.json"
  text.write_text(path, "old")
  with pytest.raises(UnicodeEncodeError):
    text.write_text(path, "new \ud800")
  assert path.read_text() == "old"


def test_the_command_line_loads_none_of_the_heavy_packages():
  heavy = "jax orbax matplotlib rich flax mujoco numpy scipy".split()
  code = (
    "import sys, apnpql_jax.cli.main, apnpql_jax.runs.metrics,"
    "apnpql_jax.runs.progress, apnpql_jax.runs.run_folder, apnpql_jax.runs.sinks;"
    f"print([name for name in {heavy} if name in sys.modules])"
  )
  command = [sys.executable, "-c", code]
  done = subprocess.run(command, check=True, capture_output=True, text=True)
  assert done.stdout.strip() == "[]"
