"""docs/add_a_task.md is followed to the letter, from an empty folder."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

from apnpql_jax import testing

ROOT = testing.ROOT


def blocks() -> dict[str, str]:
  """Returns file name -> content, from headings with names and the blocks below."""
  text = (ROOT / "docs" / "add_a_task.md").read_text()
  found = re.findall(r"^## [^\n]*`(\S+)`$.*?^```\w+\n(.*?)^```$", text, re.M | re.S)
  return dict(found)


def run(
  folder: Path, *args: str, site: Path = ROOT
) -> subprocess.CompletedProcess[str]:
  path = os.pathsep.join({str(site): None, str(ROOT): None})
  return subprocess.run(
    [sys.executable, "-m", "apnpql_jax", *args, "--json"],
    cwd=folder,
    env=dict(os.environ, PYTHONPATH=path),
    capture_output=True,
    text=True,
  )


def result(folder: Path, *args: str) -> dict:
  done = run(folder, *args)
  assert done.returncode == 0, done.stderr
  return json.loads(done.stdout)


def refusal(folder: Path, *args: str, site: Path = ROOT) -> str:
  """Returns the last line of a command that is refused."""
  done = run(folder, *args, site=site)
  assert done.returncode == 2, done.stderr
  assert "Traceback" not in done.stderr
  return done.stderr.splitlines()[-1]


def test_the_task_of_the_guide_runs(tmp_path: Path):
  made = result(tmp_path, "new-task", "touch_ball")
  assert made["task"] == "touch_ball.py" and made["scene"] == "touch_ball.xml"
  for name, content in blocks().items():
    assert (tmp_path / name).read_text() == content
  assert "touch_ball.py exists" in refusal(tmp_path, "new-task", "touch_ball")

  file = "./touch_ball.py"
  assert "touch_ball" in result(tmp_path, "list", file)["tasks"]
  collect = ("collect", file, "--episodes", "32", "--save", "mine.npz", "--solved-only")
  figures = result(tmp_path, *collect)
  assert figures["successes"] >= 31 and figures["mean_length"] < 30
  assert figures["demonstrations"] == figures["solved_demonstrations"] >= 31
  figures = result(tmp_path, *collect, "--append")
  assert figures["demonstrations"] == figures["solved_demonstrations"] >= 62

  trained = result(tmp_path, "train", file, *testing.TINY_ARGS, "--total-steps", "16")
  assert trained["run"] == str(tmp_path / "runs" / "touch_ball-1")
  given = ("--task-file", file)
  evaluate = ("evaluate", "runs/touch_ball-1", "--episodes", "4")
  resume = ("train", "--resume", "runs/touch_ball-1", "--total-steps", "32")
  export = ("export", "runs/touch_ball-1", "policy")
  # A run alone never makes a process execute the file that it names.
  for command in (evaluate, resume, export):
    line = refusal(tmp_path, *command)
    assert f"'touch_ball' is in {tmp_path / 'touch_ball.py'}" in line
    assert "--task-file" in line
  assert result(tmp_path, *evaluate, *given)["task"] == "touch_ball"
  assert result(tmp_path, *resume, *given)["env_steps"] == 32
  assert result(tmp_path, *export, *given)["task"] == "touch_ball"
  scene = tmp_path / "touch_ball.xml"
  scene.write_text(scene.read_text().replace('size="0.03"', 'size="0.04"'))
  done = run(tmp_path, *evaluate, *given)
  assert "its MJCF has changed since runs/touch_ball-1 began" in done.stderr
  (tmp_path / "touch_ball.py").rename(tmp_path / "moved.py")
  assert "touch_ball.py, which is missing" in refusal(tmp_path, *evaluate)
  assert "no file 'touch_ball.py'" in refusal(tmp_path, *evaluate, *given)


SETTINGS = """
import sys
from apnpql_jax.cli import main, sweep
from apnpql_jax.cli.train import Train, with_shortcuts
from apnpql_jax.config.checks import validate
from apnpql_jax.tasks import task_names

trained = with_shortcuts(main._parse(Train, sys.argv[1:]))
validate(trained, tasks=task_names())
assert trained == sweep.config_of(sys.argv[2:])
print(trained.env.task, trained.env.task_file)
"""


@pytest.mark.parametrize("given", ["--task-file ball.py", "--task-file=./ball.py"])
def test_a_preset_may_have_its_task_in_another_file(given, tmp_path: Path):
  result(tmp_path, "new-task", "touch_ball")
  task = (tmp_path / "touch_ball.py").read_text()
  (tmp_path / "ball.py").write_text(task[: task.index("_PUSH = ")])
  (tmp_path / "mine.py").write_text(
    "from apnpql_jax import load_preset, tasks\n"
    "assert 'touch_ball' in tasks.task_names()\n"
    "CONFIG = load_preset('push_plate')\n"
  )
  line = ["train", "./mine.py", "--env.task", "touch_ball", *given.split()]
  done = subprocess.run(
    [sys.executable, "-c", SETTINGS, *line],
    cwd=tmp_path,
    env=dict(os.environ, PYTHONPATH=str(ROOT)),
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr
  assert done.stdout.split() == ["touch_ball", str(tmp_path / "ball.py")]


def test_a_name_whose_files_could_not_be_loaded_is_refused(tmp_path: Path):
  for name in ("My Task", "2boxes", "_box", "none"):
    assert f"{name!r} cannot name a task" in refusal(tmp_path, "new-task", name)
  assert "'push_plate' exists" in refusal(tmp_path, "new-task", "push_plate")
  # Each scene includes these; a file of the same name next to it would replace them.
  for name in ("arena", "robot"):
    assert f"{name}.xml; choose another name" in refusal(tmp_path, "new-task", name)
  assert not any(tmp_path.iterdir())


def test_a_missing_folder_is_made(tmp_path: Path):
  made = result(tmp_path, "new-task", "mine", "--folder", "my/tasks")
  assert made["task"] == "my/tasks/mine.py" and (tmp_path / made["task"]).is_file()


def test_errors_name_the_file_and_the_line(tmp_path: Path):
  run(tmp_path, "new-task", "mine")
  task, scene = tmp_path / "mine.py", tmp_path / "mine.xml"
  text, mjcf = task.read_text(), scene.read_text()
  collect = ("collect", "mine.py", "--episodes", "2")

  task.write_text(text + "\n1 / 0\n")
  line = len(text.splitlines()) + 2
  assert f"mine.py:{line} fails with ZeroDivisionError" in refusal(tmp_path, *collect)
  task.write_text("def\n")
  assert "mine.py:1 fails with SyntaxError" in refusal(tmp_path, *collect)
  task.write_text("CONFIG = 3\n")
  assert "'mine.py' must define CONFIG" in refusal(tmp_path, *collect)
  task.write_text(text.replace('"mine"', '"push_plate"'))
  line = refusal(tmp_path, *collect)
  assert f"{task}" in line and "taken by" in line

  task.write_text(text)
  scene.write_text(mjcf.replace("<geom", "<geon"))
  line = refusal(tmp_path, *collect)
  assert f"{scene} does not compile" in line and "geon" in line and "line 5" in line
  assert refusal(tmp_path, "list", "mine.py") == line
  scene.unlink()
  assert f"'mine' has no scene: {scene} is missing" in refusal(tmp_path, *collect)


def test_installed_packages_bring_tasks_and_presets(tmp_path: Path):
  """A package with entry points, laid out as an installer does."""
  site = tmp_path / "site"
  package, info = site / "theirs", site / "theirs-1.0.dist-info"
  package.mkdir(parents=True), info.mkdir()
  result(tmp_path, "new-task", "touch_ball", "--folder", str(package))
  (package / "__init__.py").touch()
  (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
  (info / "entry_points.txt").write_text(
    "[apnpql.tasks]\ntouch_ball = theirs.touch_ball\nbad = theirs.missing\n"
    "[apnpql.presets]\ntouch_ball = theirs.touch_ball:CONFIG\n"
  )
  listed = run(tmp_path, "list", site=site)
  names = json.loads(listed.stdout)
  assert "touch_ball" in names["tasks"] and "touch_ball" in names["presets"]
  # A broken module costs the other tasks nothing but a line.
  assert "theirs.missing is left out" in listed.stderr
  collect = ("collect", "touch_ball", "--episodes", "8")
  assert json.loads(run(tmp_path, *collect, site=site).stdout)["successes"] == 8
  # Gymnasium has a task whose preset has the same name, and imports nothing for it.
  code = (
    "import sys, apnpql_jax.gym, gymnasium; gymnasium.spec('apnpql/TouchBall-v0'); "
    "assert not {'theirs', 'jax'} & set(sys.modules)"
  )
  path = os.pathsep.join((str(site), str(ROOT)))
  env = dict(os.environ, PYTHONPATH=path)
  subprocess.run([sys.executable, "-c", code], env=env, check=True)
