"""``apnpql sweep`` with real trainings: failures, stops, other launchers."""

from __future__ import annotations

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from apnpql_jax import testing
from apnpql_jax.reports import reading
from apnpql_jax.sweeps.manifest import (
  DONE,
  FAILED,
  STOPPED,
  WAITING,
  Manifest,
  load_manifest,
)

TRAIN = [*testing.TINY_ARGS, "--total-steps", "32"]


def start(folder: Path, *args: str) -> subprocess.Popen[str]:
  """Starts ``apnpql sweep`` with its sweep in ``folder``."""
  return subprocess.Popen(
    [sys.executable, "-m", "apnpql_jax", "sweep", *args],
    cwd=folder.parent,
    env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )


def sweep(folder: Path, *args: str) -> tuple[int, str, Manifest]:
  """Runs ``apnpql sweep`` and returns its exit code, messages and manifest."""
  process = start(folder, *args)
  _, messages = process.communicate()
  return process.returncode, messages, load_manifest(folder)


@pytest.mark.parametrize(
  "launcher", ["local", pytest.param("slurm-local", marks=pytest.mark.slow)]
)
def test_one_failure_costs_the_others_nothing_and_is_retried(launcher, tmp_path):
  if launcher != "local":
    pytest.importorskip("submitit")
  folder = tmp_path / "sweep"
  grid = ["--grid", "agent.algorithm=nope,ap_npql", "--launcher", launcher]
  line = ["push_plate", *grid, "--out", str(folder), *TRAIN]
  code, messages, found = sweep(folder, *line)
  assert code == 3 and "1 of 2 runs did not finish" in messages, messages
  bad, good = found.runs
  assert (bad.state, bad.code, good.state) == (FAILED, 2, DONE)
  assert "unknown agent.algorithm 'nope'" in bad.line and bad.line in messages
  assert reading.read(found.run_dir(good)).finished
  assert "0 of 4" in (folder / f"{good.name}.log").read_text()
  code, messages, found = sweep(folder, *line)
  assert code == 3 and [entry.attempts for entry in found.runs] == [2, 1]


@pytest.mark.slow
def test_ctrl_c_saves_the_runs_and_a_resume_continues(tmp_path):
  folder = tmp_path / "runs" / "push_plate-sweep-1"
  line = ["push_plate", "--seeds", "2", *testing.TINY_ARGS, "--total-steps", "100000"]
  process = start(folder.parent, *line)
  name = "push_plate-seed_0"
  while not testing.rows(folder / name):
    assert process.poll() is None, process.communicate()
    time.sleep(0.1)
  process.send_signal(signal.SIGINT)
  _, messages = process.communicate()
  assert process.returncode == 130, messages
  first, second = load_manifest(folder).runs
  assert (first.state, first.code, second.state) == ("stopped", 143, "waiting")
  assert "saved at step" in first.line
  assert "apnpql sweep --resume runs/push_plate-sweep-1" in messages
  checkpoints = folder / name / "checkpoints"
  assert any(path.name.isdecimal() for path in checkpoints.iterdir())
  # The rest of the steps would take too long: one more iteration is all.
  config = folder / name / "config.json"
  done = max(int(x.name) for x in checkpoints.iterdir() if x.name.isdecimal())
  data = json.loads(config.read_text()) | {"total_steps": done + testing.STEPS}
  config.write_text(json.dumps(data))
  process = start(folder.parent, "--resume", str(folder))
  while load_manifest(folder).runs[0].state != DONE:
    assert process.poll() is None, process.communicate()
    time.sleep(0.1)
  process.send_signal(signal.SIGTERM)
  _, messages = process.communicate()
  assert process.returncode == 143 and f"done {name}" in messages, messages
  first, second = load_manifest(folder).runs
  assert first.attempts == 2 and second.state in (STOPPED, WAITING)
  assert not (folder.parent / "push_plate-sweep-2").exists()
