"""A fault of the policy process stops the arm at once, and its episode is in the log.

The process is the real one. It repeats a log, so that it needs no JAX, and its cameras
fail as those of a vendor do.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import functools
from multiprocessing import get_context
from pathlib import Path
import resource
import threading
from typing import Any
from unittest import mock

import mujoco
import numpy as np
import pytest
from test_processes import CLOCK, rig, speed, start_motion, until

from apnpql_jax.data import lerobot
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import devices, policy_folder, policy_process
from apnpql_jax.robot.blackboard import Blackboard, Phase, text
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.protocols import CAMERAS, Frame
from apnpql_jax.robot.recorder import Recorder
from apnpql_jax.robot.simulated import process as simulation
from apnpql_jax.robot.supervisor import Mode
from apnpql_jax.testing import export_untrained

CONTEXT = get_context("spawn")
FAULT = "camera wrist: sent no frame for 0.2 s: check its cable"


class Camera:
  """A camera that can be unplugged."""

  def __init__(self, clock: Clock, view: dict[str, Any], unplugged: Any = None):
    self._clock, self._unplugged = clock, unplugged
    self._image = np.zeros((view["height"], view["width"], 3), np.uint8)

  def describe(self) -> dict[str, Any]:
    return {"serial_number": f"{self._image.shape[0]} rows"}

  def get_observation(self) -> Frame:
    if self._unplugged and self._unplugged.is_set():
      raise DeviceError(FAULT)
    return Frame(self._clock.now(), self._image)


def policy(
  folder: Path,
  log: str,
  unplugged: Any,
  full: Any,
  board_name: str,
  peer: Any,
  clock: Clock,
) -> None:
  """Runs the policy process, with cameras and a disk that fail at an event."""
  contract = policy_folder.load(folder / "policy").contract

  @contextlib.contextmanager
  def cameras(robot: Robot) -> Generator[tuple[list[Camera], None]]:
    views = robot.contract["cameras"]
    yield [Camera(clock, views[x], unplugged) for x in CAMERAS], None

  class Log(Recorder):
    def end_episode(self, success: bool | None) -> int | None:
      if full.is_set():
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
      return super().end_episode(success)

  options = {
    "policy": str(folder / "policy"),
    "seed": 0,
    "log": str(folder / log),
    "replay": str(folder / "recorded"),
  }
  robot = Robot("double", contract, Cell(), clock)
  with (
    mock.patch.object(devices, "open_cameras", cameras),
    mock.patch.object(policy_process, "Recorder", Log),
  ):
    policy_process.main(robot, board_name, options, peer)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
  """Returns a folder with a policy, and a log that moves the shoulder."""
  pytest.importorskip("pyarrow")
  made = tmp_path_factory.mktemp("policy-process")
  contract = export_untrained(made / "policy", time_limit_s=30.0)
  views = contract["cameras"]
  images = [Camera(CLOCK, views[x]).get_observation() for x in CAMERAS]
  state: dict[str, Any] = dict.fromkeys(("position", "command", "wrench"), np.zeros(6))
  state |= dict.fromkeys(("gripper", "time", "gripper_time"), 0.0)
  action = np.array([1.0, 0, 0, 0, 0, 0, 1])
  with Recorder(made / "recorded", contract, judged=False) as recorder:
    for _ in range(20):
      recorder.add(0.0, 0.0, state, action, images)
    recorder.end_episode(None)
  return made


def test_an_unplugged_camera_stops_the_arm_and_its_episode_is_in_the_log(folder):
  contract = policy_folder.load(folder / "policy").contract
  unplugged, full = CONTEXT.Event(), CONTEXT.Event()
  target = functools.partial(policy, folder, "log", unplugged, full)
  with (
    rig(target, contract) as (board, run),
    Blackboard(run.plant, simulation.RECORDS) as plant,
  ):
    until(lambda: bool(board["policy"].read()["ready"]))
    order = start_motion(board)
    unplugged.set()
    until(lambda: text(board["policy"].read()["error"]) == FAULT)
    assert speed(plant) > 0.3
    assert until(lambda: speed(plant) < 0.01) < 0.5
    until(lambda: not run.control.is_alive() and not run.policy.is_alive())
    state, found = board["state"].read(), board["policy"].read()
    assert (state["mode"], text(state["reason"])) == (Mode.STOP, FAULT)
    assert state["at_rest"] and FAULT in run.reasons()
    assert (found["ended"], found["over"]) == (order, 0)
  log, views = lerobot.read(folder / "log"), contract["cameras"]
  assert log.about["devices"] == {
    "robot": "double",
    "arm": {"model": "simulated UR5e", "mujoco": mujoco.__version__},
    "gripper": {"model": "simulated RH-P12-RN"},
    "cameras": {x: {"serial_number": f"{views[x]['height']} rows"} for x in CAMERAS},
  }
  assert len(log.episodes) == found["index"] + 1
  assert len(log.episodes[-1].actions) == found["actions"] > 0
  assert log.episodes[-1].success is None


def test_a_disk_that_fills_ends_the_session_with_one_line(folder):
  contract = policy_folder.load(folder / "policy").contract
  unplugged, full = CONTEXT.Event(), CONTEXT.Event()
  target = functools.partial(policy, folder, "full", unplugged, full)
  with rig(target, contract) as (board, run):
    until(lambda: bool(board["policy"].read()["ready"]))
    order = start_motion(board)
    full.set()
    board["order"].write({"number": order + 1, "phase": Phase.IDLE})
    until(lambda: not run.control.is_alive() and not run.policy.is_alive())
    state, found = board["state"].read(), board["policy"].read()
    error = text(found["error"])
    assert "full" in error and "File too large" in error and "\n" not in error
    assert state["at_rest"] and found["ended"] < order
  assert len(lerobot.read(folder / "full").episodes) == found["index"] + 1


def compiling(peer: Any) -> None:
  """Returns a policy process that is not ready yet."""
  never = threading.Event()
  args = peer, never, threading.Event()
  threading.Thread(target=policy_process._end_with, args=args, daemon=True).start()
  never.wait(100.0)


def test_a_policy_that_was_replaced_after_it_was_checked_is_not_played(folder):
  checked = policy_folder.load(folder / "policy").contract | {"task": "another"}
  options = {"policy": str(folder / "policy"), "seed": 0, "log": None, "replay": None}
  process = functools.partial(
    policy_process.main, Robot("double", checked, Cell(), CLOCK), options=options
  )
  ours, theirs = CONTEXT.Pipe()
  with Blackboard() as board:
    played = CONTEXT.Process(
      target=process, kwargs={"board_name": board.name, "peer": theirs}
    )
    played.start()
    try:
      assert ours.poll(60)
      assert "was replaced" in ours.recv()
    finally:
      ours.close()
      theirs.close()
      played.join(60)
  assert not played.is_alive()


def test_a_policy_that_compiles_ends_at_once_with_the_control_process():
  ours, theirs = CONTEXT.Pipe()
  process = CONTEXT.Process(target=compiling, args=(theirs,))
  process.start()
  theirs.close()
  ours.close()
  process.join(policy_process.END_S)
  assert process.exitcode == 1
