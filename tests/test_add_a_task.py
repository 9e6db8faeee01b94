"""docs/add_a_task.md is followed to the letter, in a copy of the project."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]


def blocks() -> dict[str, str]:
  """File name -> content, from headings that name a file and the block after them."""
  text = (ROOT / "docs" / "add_a_task.md").read_text()
  found = re.findall(r"^## [^\n]*`(\S+)`$.*?^```\w+\n(.*?)^```$", text, re.M | re.S)
  return dict(found)


def test_the_task_of_the_guide_runs(tmp_path: Path):
  for folder in ("apnpql_jax", "mjcf", "experiments"):
    skip = shutil.ignore_patterns("__pycache__", "results")
    shutil.copytree(ROOT / folder, tmp_path / folder, ignore=skip)
  files = blocks()
  assert [Path(name).parent.name for name in files] == ["mjcf", "tasks", "experiments"]
  for name, content in files.items():
    assert not (tmp_path / name).exists()
    (tmp_path / name).write_text(content)

  def apnpql(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
      [sys.executable, "-m", "apnpql_jax", *args, "--json"],
      cwd=tmp_path,
      env=dict(os.environ, PYTHONPATH=str(tmp_path)),
      capture_output=True,
      text=True,
    )

  # Neither a broken file nor a copy that keeps its name costs the other tasks anything.
  tasks = tmp_path / "apnpql_jax" / "tasks"
  (tasks / "broken.py").write_text("1 / 0\n")
  shutil.copy(tasks / "push_plate.py", tasks / "a_copy.py")
  listed = apnpql("list")
  names = json.loads(listed.stdout)
  assert "touch_ball" in names["tasks"] and "touch_ball" in names["presets"]
  line = "apnpql_jax.tasks.broken is left out: ZeroDivisionError: division by zero"
  assert listed.stderr.count(line) == 1 and len(listed.stderr.splitlines()) == 2
  refused = apnpql("collect", "push_plate")
  assert refused.returncode == 2 and "'push_plate'" in refused.stderr.splitlines()[-1]
  assert "is taken by apnpql_jax.tasks.a_copy" in refused.stderr.splitlines()[-1]

  collect = "collect touch_ball --episodes 32 --save mine.npz --solved-only".split()
  figures = json.loads(apnpql(*collect).stdout)
  assert figures["successes"] >= 31 and figures["mean_length"] < 30
  assert figures["demonstrations"] == figures["solved_demonstrations"] >= 31
  figures = json.loads(apnpql(*collect, "--append").stdout)
  assert figures["demonstrations"] == figures["solved_demonstrations"] >= 62
