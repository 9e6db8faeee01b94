"""The command through the vendors' clients, against doubles of all devices.

The doubles keep the time of the machine. One that is too busy for them ends an episode
with a fault; so each test may try again.
"""

from __future__ import annotations

import json
from pathlib import Path
import time

import numpy as np
import pytest
from test_run import folder, start, this_checkout  # noqa: F401

from apnpql_jax.data import lerobot
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.server import ask

pytestmark = pytest.mark.slow

PACKAGES = "rtde_control", "dynamixel_sdk", "pyrealsense2", "cv2", "pyarrow"
ROBOT = ["run", "--robot", "double", "--policy", "policy", "--json"]
TRIES = 5


@pytest.fixture(autouse=True)
def clients() -> None:
  for name in PACKAGES:
    pytest.importorskip(name)


def episodes(log: Path) -> list[dict]:
  """Returns the lines of a log."""
  if not (log / "episodes.jsonl").exists():
    return []
  return [json.loads(x) for x in (log / "episodes.jsonl").read_text().splitlines()]


def test_a_policy_plays_and_its_log_is_whole(folder):  # noqa: F811
  for attempt in range(TRIES):
    log = folder / f"doubled-{attempt}"
    process = start(*ROBOT, "--episodes", "1", "--log", log.name, cwd=folder)
    shown, errors = process.communicate(timeout=300)
    found = json.loads(shown)
    assert process.returncode == found.get("exit_code", 0), errors
    assert found["arm"] == "the arm is at rest"
    if found["reasons"] == ["time limit"]:
      break
    assert "Traceback" not in errors
  else:
    raise AssertionError(f"{found} {errors}")
  assert "success_rate" not in found  # Nobody can tell.
  (line,) = episodes(log)
  assert line["solved"] is None and line["dataset_index"] == 0
  (kept,) = lerobot.read(log).episodes
  assert kept.success is None
  assert len(kept.actions) == line["actions"] == 16 - line["missed_periods"]
  times = kept.columns["times"]
  assert (np.diff(times, axis=0) >= 0).all()
  assert (times[:, 4:] >= times[:, :4]).all()  # Measured before the action.
  assert np.abs(np.diff(kept.joints, axis=0)).max() > 0.01  # The arm moved.
  assert len({x.tobytes() for x in kept.images("observation.images.global")}) > 1


FAULTS = {
  "unplug_cameras": "camera ",
  "silence_gripper": "gripper: ",
  "protective_stop": "arm: protective stop",
  "drop_rtde": ("arm: lost the connection", "joints: measurement is ", "127."),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_ends_the_session_with_its_episode_in_the_log(folder, fault):  # noqa: F811
  for attempt in range(TRIES):
    log = folder / f"{fault}-{attempt}"
    process = start(*ROBOT, "--episodes", "50", "--log", log.name, cwd=folder)
    host = doubles.address(process.pid, 0)
    in_an_episode = wait_for_an_action(host, process)
    if in_an_episode:
      ask(host, fault)
    shown, errors = process.communicate(timeout=300)
    assert process.returncode == 3 and "Traceback" not in errors, errors
    found, kept = json.loads(shown), episodes(log)
    if in_an_episode and kept and kept[-1]["reason"].startswith(FAULTS[fault]):
      break
  else:
    raise AssertionError(f"{found} {errors}")
  assert found["exit_code"] == 3 and found["failure"]
  assert found["reasons"] == [x["reason"] for x in kept]
  dataset = lerobot.read(log).episodes
  assert kept[-1]["dataset_index"] == len(dataset) - 1
  assert len(dataset[-1].actions) == kept[-1]["actions"] > 0


def wait_for_an_action(host: str, process) -> bool:
  """Waits until the arm has been at rest, and then moves fast, as in an episode."""
  end, still = time.monotonic() + 200, 0
  last = None
  while process.poll() is None and time.monotonic() < end:
    try:
      state = ask(host, "state")
    except DeviceError:  # Not yet.
      time.sleep(0.1)
      continue
    now = np.array(state["position"])
    moved = 0.0 if last is None else float(np.abs(now - last).max())
    if still > 3 and moved > 0.02:
      return True
    still, last = still + (moved < 1e-4), now
    time.sleep(0.1)
  return False
