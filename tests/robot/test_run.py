"""Whole runs of the command on the simulated robot, with a real exported policy."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.data import lerobot
from apnpql_jax.robot.interrupts import INTERRUPTS
from apnpql_jax.robot.sensor import FREE_FORCE, load
from apnpql_jax.testing import export_untrained

ROBOT = ["--robot", "simulated", "--policy", "policy", "--slowdown", "8"]


def start(*args: str, cwd: Path, command: str = "robot") -> subprocess.Popen[str]:
  """Starts ``apnpql robot``, or another command, in a process of its own."""
  return subprocess.Popen(
    [sys.executable, "-m", "apnpql_jax", command, *args],
    cwd=cwd,
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
    start_new_session=True,
  )


def output(*args: str, cwd: Path, command: str = "robot") -> tuple[str, str]:
  """Returns standard output and standard error of a command that succeeds."""
  process = start(*args, cwd=cwd, command=command)
  shown, errors = process.communicate(timeout=1200)
  assert process.returncode == 0, errors
  return shown, errors


def is_orderly(reason: str) -> bool:
  """Returns whether an untrained policy may end an episode so: it may hit something."""
  hit = r"force: \d+ N on the tool( for 1 s)?|arm: 0\.\d{3} rad from its command"
  return re.fullmatch(f"time limit|{hit}", reason) is not None


def check_events(episode: dict) -> None:
  """Checks that an episode begins and ends as it should, and follows the policy."""
  times, modes, reasons = zip(*episode["events"], strict=True)
  assert list(times) == sorted(times) and times[0] >= 0
  assert (modes[0], reasons[0]) == ("hold", "policy: no action yet")
  assert modes[1] == "follow" and "follow" not in modes[modes.index("stop") :]
  ended = episode["reason"] == "time limit"
  last = "session: the episode is over" if ended else episode["reason"]
  assert (modes[-1], reasons[-1]) == ("stop", last)
  for mode, reason in zip(modes[1:-1], reasons[1:-1], strict=True):
    assert reason == "" if mode == "follow" else reason.startswith("force: ")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
  """Returns a folder with a policy."""
  found = tmp_path_factory.mktemp("robot")
  export_untrained(found / "policy", time_limit_s=2.4)
  return found


@pytest.fixture(autouse=True)
def this_checkout(monkeypatch) -> None:
  """Lets processes import this checkout."""
  path = os.pathsep.join([str(testing.ROOT), os.environ.get("PYTHONPATH", "")])
  monkeypatch.setenv("PYTHONPATH", path)


@pytest.mark.slow
def test_an_untrained_policy_plays_its_episodes_in_order(folder):
  pytest.importorskip("pyarrow")
  shown, _ = output("check", *ROBOT, cwd=folder)
  for name in ("arm", "gripper", "camera global", "camera wrist", "admittance"):
    assert f"\n{name} " in f"\n{shown}"
  assert "inside the workspace box" in shown

  args = "run", *ROBOT, "--episodes", "2", "--json"
  shown, errors = output(*args, "--log", "log", cwd=folder)
  found = json.loads(shown)
  assert found["episodes"] == 2 and found["successes"] == 0
  assert all(map(is_orderly, found["reasons"])) and found["actions"] >= 2
  for number in (1, 2):
    assert sum(f"episode {number} of 2: " in x for x in errors.splitlines()) == 1

  lines = (folder / "log" / "episodes.jsonl").read_text().splitlines()
  kept = [json.loads(line) for line in lines]
  assert [x["reason"] for x in kept] == found["reasons"]
  assert [x["dataset_index"] for x in kept] == [0, 1]
  for episode in kept:
    check_events(episode)
    assert load(np.array(episode["homing_after"]["unloaded_wrench"])) <= 1
  assert kept[1]["homing_before"] == kept[0]["homing_after"]
  assert 0 < found["zero_error_n"] <= FREE_FORCE
  log = lerobot.read(folder / "log")
  assert log.about["devices"]["robot"] == "simulated"
  assert [*log.about["devices"]["cameras"]] == ["global", "wrist"]
  first = log.episodes[0]
  interrupted = kept[0]["reason"] != "time limit"
  assert len(first.actions) == kept[0]["actions"] + (not interrupted)
  assert np.abs(first.actions[:, :6]).max() <= 1

  convert = "log", "push_plate", "mine.npz", "--allow-unsolved", "--json"
  shown, _ = output(*convert, command="convert", cwd=folder)
  assert json.loads(shown)["demonstrations"] >= 2  # More if periods were missed.

  once = *args[:-3], "--episodes", "1", "--json", "--log", "again"
  shown, _ = output(*once, "--replay", "log", cwd=folder)
  assert is_orderly(json.loads(shown)["reasons"][0])
  repeated = lerobot.read(folder / "again").episodes
  if json.loads(shown)["actions"]:  # A busy machine may stop the arm at once.
    count = min(len(repeated[0].actions), len(first.actions))
    np.testing.assert_array_equal(repeated[0].actions[:count], first.actions[:count])


@pytest.mark.slow
@pytest.mark.parametrize("number", INTERRUPTS)
def test_a_signal_to_all_brings_the_arm_to_rest_and_ends_all_processes(folder, number):
  process = start("run", *ROBOT, "--episodes", "50", cwd=folder)
  assert process.stderr is not None
  while "episode 1 of 50" not in (line := process.stderr.readline()):
    assert line, "it ended"
  time.sleep(8.0)  # Into the next episode, or on the way to it.
  os.killpg(process.pid, number)
  _, errors = process.communicate(timeout=120)
  assert process.returncode == 128 + number
  assert f"{number.name}: the arm is at rest" in errors
  # Two of them end Python's resource tracker, which complains.
  if number not in (signal.SIGHUP, signal.SIGQUIT):
    assert "Traceback" not in errors and "leaked" not in errors
  # The resource tracker of Python notices the end a moment later.
  until = time.monotonic() + 20
  while subprocess.run(["pgrep", "-s", str(process.pid)], capture_output=True).stdout:
    assert time.monotonic() < until
    time.sleep(0.2)
