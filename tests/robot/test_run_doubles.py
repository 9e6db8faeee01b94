"""The command through the vendors' clients, against doubles of all devices.

The doubles keep the time of the machine. One that is too busy for 500 cycles per second
ends an episode with a fault. So each test tries again, and skips on a machine that is
never in time.
"""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import time

import numpy as np
import pytest
from test_run import folder, is_orderly, start, this_checkout  # noqa: F401

from apnpql_jax.data import lerobot
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.controller import SERIAL, VERSION
from apnpql_jax.robot.doubles.dynamixel import FIRMWARE
from apnpql_jax.robot.doubles.plant import DRIFT
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers.rh_p12_rn import RNA

pytestmark = pytest.mark.slow

PACKAGES = "rtde_control", "dynamixel_sdk", "pyrealsense2", "cv2", "pyarrow"
ROBOT = ["run", "--robot", "double", "--policy", "policy", "--json"]
TRIES = 4


@pytest.fixture(autouse=True)
def clients() -> None:
  for name in PACKAGES:
    pytest.importorskip(name)


def episodes(log: Path) -> list[dict]:
  """Returns the lines of a log."""
  if not (log / "episodes.jsonl").exists():
    return []
  return [json.loads(x) for x in (log / "episodes.jsonl").read_text().splitlines()]


def finish(process: subprocess.Popen[str]) -> tuple[dict, str]:
  """Returns the result of a command, and what it wrote to standard error."""
  shown, errors = process.communicate(timeout=300)
  assert "Traceback" not in errors, errors
  found = json.loads(shown)
  assert process.returncode == found.get("exit_code", 0)
  return found, errors


def is_in_time(found: dict) -> bool:
  """Returns whether the machine was fast enough for the doubles."""
  return not found["overruns"] and not found["missed_periods"]


def check_devices(found: dict) -> None:
  """Checks that a log names the devices of its session."""
  assert found["robot"] == "double"
  assert found["arm"]["serial_number"] == SERIAL
  assert found["arm"]["polyscope"] == ".".join(map(str, VERSION))
  gripper = found["gripper"]
  assert (gripper["model"], gripper["firmware"]) == (RNA.name, FIRMWARE)
  for name, camera in found["cameras"].items():
    assert camera["serial_number"] == f"double-{name}"
    assert camera["firmware"] and camera["stream"] and camera["lens"]


def test_a_policy_plays_and_its_log_is_whole(folder):  # noqa: F811
  for attempt in range(TRIES):
    log = folder / f"doubled-{attempt}"
    process = start(*ROBOT, "--episodes", "1", "--log", log.name, cwd=folder)
    found, errors = finish(process)
    if found["actions"] and is_orderly(found["reasons"][0]):
      break
    assert not is_in_time(found), found
  else:
    pytest.skip(f"the machine is too busy: {errors}")
  (reason,) = found["reasons"]
  assert "success_rate" not in found  # Nobody can tell.
  (line,) = episodes(log)
  assert line["solved"] is None and line["dataset_index"] == 0
  assert (line["reason"], line["actions"]) == (reason, found["actions"])
  dataset = lerobot.read(log)
  check_devices(dataset.about["devices"])
  (kept,) = dataset.episodes
  ended = reason == "time limit"  # With a frame of what the last action has led to.
  assert kept.success is None and len(kept.actions) == line["actions"] + ended
  if ended:
    assert line["actions"] == 16 - line["missed_periods"]
    assert np.abs(np.diff(kept.joints, axis=0)).max() > 0.01  # The arm moved.
    assert len({x.tobytes() for x in kept.images("observation.images.global")}) > 1
    assert found["arm"] == "the arm is at rest"
  times = kept.columns["times"]
  assert (np.diff(times, axis=0) >= 0).all()
  assert (times[:, 4:] >= times[:, :4]).all()  # Measured before the action.


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
    if moving := wait_for_an_action(host, process):
      ask(host, fault)
    found, errors = finish(process)
    assert found["exit_code"] == 3 and found["failure"], errors
    kept = episodes(log)
    assert found["reasons"] == [x["reason"] for x in kept]
    hit = [x for x in kept if x["reason"].startswith(FAULTS[fault])]
    if moving and hit:
      break
    assert not moving or not is_in_time(found), found
  else:
    pytest.skip(f"the machine is too busy: {errors}")
  dataset = lerobot.read(log).episodes
  assert len(dataset[hit[0]["dataset_index"]].actions) == hit[0]["actions"] > 0


def test_a_sensor_that_drifts_in_an_episode_ends_the_session_after_it(folder):  # noqa: F811
  for attempt in range(TRIES):
    log = folder / f"drift-{attempt}"
    process = start(*ROBOT, "--episodes", "50", "--log", log.name, cwd=folder)
    host = doubles.address(process.pid, 0)
    if moving := wait_for_an_action(host, process):
      ask(host, "drift_force")
    found, errors = finish(process)
    assert found["exit_code"] == 3 and found["failure"], errors
    if moving and "at rest: free the hand" in found["failure"]:
      break
    assert not moving or not is_in_time(found), found
  else:
    pytest.skip(f"the machine is too busy: {errors}")
  after = episodes(log)[-1]["homing_after"]
  np.testing.assert_allclose(after["unloaded_wrench"], DRIFT, atol=1.0)
  assert found["zero_error_n"] == pytest.approx(
    np.linalg.norm(after["unloaded_wrench"][:3])
  )


def wait_for_an_action(host: str, process: subprocess.Popen[str]) -> bool:
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
