"""The script of the page "Use it as a library" runs as it stands."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import re
import subprocess
import sys

import pytest

from apnpql_jax import testing

PAGE = (testing.ROOT / "docs" / "library.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.M | re.S)
SCRIPT, GYMNASIUM, SAC, BRAX = BLOCKS


def output(folder: Path, script: str) -> str:
  """Returns what a script prints in an empty folder."""
  (folder / "script.py").write_text(script)
  done = subprocess.run(
    [sys.executable, "script.py"],
    cwd=folder,
    env=os.environ | {"XLA_FLAGS": testing.XLA_FLAGS, "PYTHONPATH": str(testing.ROOT)},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr[-2000:]
  return done.stdout


def test_the_script_of_the_library_page_runs(tmp_path: Path):
  rewards, trained, evaluated, *actions = output(tmp_path, SCRIPT).splitlines()
  assert rewards.startswith("rewards: [")
  assert ast.literal_eval(trained)["env_steps"] == 32
  assert ast.literal_eval(evaluated)["episodes"] == 4
  assert len(actions) > 4 and actions[0].startswith("actions at step 32 [[")
  assert (tmp_path / "runs" / "library" / "metrics.jsonl").exists()


def test_the_other_interfaces_of_the_library_page_run(tmp_path: Path):
  gymnasium = GYMNASIUM.replace("num_envs=32", "num_envs=2")
  gymnasium += "  print(envs.reset()[0]['wrist_image'].shape)\n"
  assert output(tmp_path, gymnasium) == "(2, 36, 64, 3)\n"
  brax = BRAX.replace("32", "2") + "  print(state.done)\n"
  assert output(tmp_path, brax) == "[0. 0.]\n"


@pytest.mark.slow
def test_the_sac_of_the_library_page_runs(tmp_path: Path):
  pytest.importorskip("stable_baselines3")
  short = SAC.replace("30_720", "32").replace("64", "2")
  assert output(tmp_path, short).splitlines()[-1] == "0.0"
