"""The way home of a session, whose simulated robot may need help.

Session, control and plant are the real ones; a thread turns the clock of the rig.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import functools
from pathlib import Path
import re
import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rigs
from rigs import NEUTRAL

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.blackboard import Blackboard
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.episodes import Homing, Options
from apnpql_jax.robot.hand import THERE_RAD
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.sensor import load
from apnpql_jax.robot.session import Session
from apnpql_jax.robot.simulated.devices import Operator
from apnpql_jax.robot.simulated.process import RECORDS
from apnpql_jax.sim import motors

CONTRACT: dict[str, Any] = {
  "task": "stack_box",
  "joints": {
    "neutral": [*NEUTRAL, 1.1],
    "gripper": {"open_rad": 0.0, "closed_rad": 1.1},
  },
}
JAM = re.compile(r"gripper: still at 0\.\d\d rad after 3 s")
POLICY = PolicyFolder(Path("policy"), CONTRACT)


class Rig(rigs.Rig):
  """A rig that may have a box between its fingers, until an operator takes it out."""

  jammed = False

  def step(self, seconds: float) -> None:
    if self.jammed and not self.objects_placed:
      self.hold_box()
    super().step(seconds)

  @property
  def objects_placed(self) -> int:
    """How often an operator has placed the objects."""
    return int(self.plant_board["scene"].read()["number"])

  def open_fingers(self) -> None:
    """Opens them without the control process."""
    while self.finger > 0.01:
      self.plant.step(None, close=False)

  def hold_box(self) -> None:
    """Keeps a box where the fingers would close."""
    data, joint = self.plant.data, self.plant.model.body("yellow").jntadr[0]
    at = self.plant.model.jnt_qposadr[joint]
    data.qpos[at : at + 3] = data.site("tool").xpos
    data.qvel[self.plant.model.jnt_dofadr[joint] :][:6] = 0.0


@contextlib.contextmanager
def playing(*, operator: bool) -> Generator[tuple[Session, Rig]]:
  """Yields a session between two episodes, and its rig, whose clock runs.

  Its fingers are open and begin an episode closed.
  """
  session = Session(Robot("simulated", CONTRACT, Cell()), POLICY, Options())
  processes: Any = SimpleNamespace(ended=[], events=list)
  session.processes, over = processes, threading.Event()
  with contextlib.ExitStack() as stack:
    board = stack.enter_context(Blackboard(records=RECORDS))
    rig = Rig(session.board, board, task_name="stack_box")
    rig.open_fingers()
    if operator:
      wait = functools.partial(session._wait, seconds=60.0)
      session._operator = Operator(board, wait)

    def turn() -> None:
      while not over.is_set():
        rig.turn()

    thread = threading.Thread(target=turn)
    thread.start()
    try:
      yield session, rig
    finally:
      over.set()
      thread.join()
      session.processes = None
      session.close()


@pytest.mark.parametrize("operator", [True, False])
def test_a_robot_that_gets_home_needs_no_help(operator):
  with playing(operator=operator) as (session, rig):
    session.go_home()
    read = session.homing.unloaded_wrench
    assert read is not None and load(np.array(read)) <= 1
    assert session.homing == Homing(unloaded_wrench=read)
    assert rig.objects_placed == 0


def test_a_jammed_gripper_of_a_simulated_robot_is_freed():
  with playing(operator=True) as (session, rig):
    rig.jammed = True
    session.go_home()
    assert session.homing.reset_reason is not None
    assert JAM.fullmatch(session.homing.reset_reason)
    assert session.homing.unloaded_wrench is not None
    assert abs(rig.finger - 1.1) < THERE_RAD
    assert rig.objects_placed == 1
    session.go_home()
    assert session.homing.reset_reason is None


def test_a_gripper_that_does_not_move_again_ends_the_session(monkeypatch):
  monkeypatch.setattr(motors, "gripper_torque", lambda *_, **__: 0.0)  # No power.
  with playing(operator=True) as (session, rig):
    with pytest.raises(DeviceError, match=f"the arm is not home: {JAM.pattern}"):
      session.go_home()
    assert (
      session.homing.reset_reason is not None and session.homing.unloaded_wrench is None
    )
    assert rig.objects_placed == 1


def test_nobody_frees_a_real_gripper():
  with playing(operator=False) as (session, rig):
    rig.jammed = True
    with pytest.raises(DeviceError, match=f"the arm is not home: {JAM.pattern}"):
      session.go_home()
    assert session.homing == Homing()


def test_a_sensor_that_has_drifted_ends_the_session_and_is_recorded():
  with playing(operator=True) as (session, rig):
    session.go_home()
    rig.plant.sensor.drift(np.array([0, 0, 20.0, 0, 0, 0]))
    with pytest.raises(DeviceError, match="the arm is not home: the arm reads"):
      session.go_home()
    assert (
      session.homing.unloaded_wrench is not None
      and session.homing.unloaded_wrench[2] > 12
    )
