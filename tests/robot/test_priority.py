"""Real-time priority reaches the threads of the drivers."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from apnpql_jax.robot import priority
from apnpql_jax.testing import ROOT

PROGRAM = """
from multiprocessing import Pipe
import os
import threading
from apnpql_jax.robot import control_process, description, devices
from apnpql_jax.robot.blackboard import Blackboard
from apnpql_jax.robot.cell import Cell

def open_arm(robot):
  show = lambda: print(os.sched_getscheduler(0) == os.SCHED_FIFO, flush=True)
  thread = threading.Thread(target=show)
  thread.start()
  thread.join()
  raise RuntimeError("no arm")

devices.open_arm = open_arm
contract = {"control_period_s": 0.15, "joints": {"ranges": [[-6.28, 6.28]] * 7}}
robot = description.Robot("ur5e", contract, Cell())
ours, theirs = Pipe()
with Blackboard() as board:
  control_process.main(robot, board.name, {"admittance": False}, theirs, theirs)
print(ours.recv())
"""


@pytest.mark.skipif(not priority.is_granted(), reason="needs a limit rtprio of 20")
def test_threads_of_drivers_have_the_priority_of_the_control_process():
  command = [sys.executable, "-c", PROGRAM]
  done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
  assert done.stdout.split("\n")[:2] == ["True", "RuntimeError: no arm"], done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="needs Linux")
def test_a_question_keeps_the_priority():
  before = os.sched_getscheduler(0)
  priority.is_granted()
  assert os.sched_getscheduler(0) == before
