"""A whole run of the command on the simulated robot, with a real exported policy."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

import pytest

from apnpql_jax import testing
from apnpql_jax.testing import export_untrained

SLOWDOWN = "8"


def command(*args: str, cwd: Path) -> subprocess.CompletedProcess[str]:
  """Runs ``apnpql robot`` in a process of its own."""
  return subprocess.run(
    [sys.executable, "-m", "apnpql_jax", "robot", *args],
    cwd=cwd,
    env=None,
    capture_output=True,
    text=True,
    timeout=1200,
  )


@pytest.mark.slow
def test_an_untrained_policy_plays_its_episodes_in_order(tmp_path, monkeypatch):
  monkeypatch.setenv("PYTHONPATH", str(testing.ROOT))
  export_untrained(tmp_path / "policy", time_limit_s=2.4)
  common = ["--robot", "simulated", "--policy", "policy", "--slowdown", SLOWDOWN]
  checked = command("check", *common, cwd=tmp_path)
  assert checked.returncode == 0, checked.stderr
  for name in ("arm", "gripper", "camera global", "camera wrist", "admittance"):
    assert f"\n{name} " in f"\n{checked.stdout}"
  assert "inside the workspace box" in checked.stdout

  played = command("run", *common, "--episodes", "2", "--json", cwd=tmp_path)
  assert played.returncode == 0, played.stderr
  found = json.loads(played.stdout)
  assert found["episodes"] == 2 and found["successes"] == 0
  for reason in found["reasons"]:  # Random motions may hit the table.
    assert reason == "time limit" or reason.startswith(("force: ", "arm: ", "policy: "))
  assert found["actions"] >= 2
  lines = played.stderr.splitlines()
  assert sum("episode 1 of 2: " in line or "episode 2 of 2: " in line for line in lines)
