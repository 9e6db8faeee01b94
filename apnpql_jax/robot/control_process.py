"""The control process: 500 cycles per second between the devices and the board.

It does not import JAX, so that neither a compilation nor a thread pool can delay it.
When it ends, so does the policy process. It brakes when the policy process or the main
process ends.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
from multiprocessing import parent_process
from multiprocessing.connection import Connection
import select
import sys

from apnpql_jax.errors import reason
from apnpql_jax.robot import devices, interrupts, priority
from apnpql_jax.robot.blackboard import Blackboard, Phase
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.control import Control
from apnpql_jax.robot.core import Core
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.hand import Hand
from apnpql_jax.robot.limits import TIMESTEP

REST_S = 1.0
"""Time that the arm may take to come to rest when the process ends, s."""


def main(
  robot: Robot, board_name: str, options: dict, events: Connection, peer: Connection
) -> None:
  """Runs the process.

  Args:
    robot: What to open.
    board_name: Name of the board.
    options: ``admittance``: whether contacts move the virtual arm.
    events: Gets changes of the mode, and an error that ends the process, as text.
    peer: Pipe from the policy process, which alone holds the other end and may send
      why it ends.
  """
  interrupts.leave_to_the_main_process()
  # More often than every 5 ms, so that the drivers' threads do not hold up cycles.
  sys.setswitchinterval(5e-4)
  board = Blackboard(board_name)
  admittance = robot.cell.admittance() if options["admittance"] else None
  core = Core(robot.cell.limits(robot.contract), admittance=admittance)
  try:
    if robot.kind == "ur5e":
      priority.ask()  # First: the threads of the drivers inherit it.
    with devices.open_arm(robot) as (arm, gripper):
      ends = robot.contract["joints"]["gripper"]
      hand = Hand(gripper, open_rad=ends["open_rad"], closed_rad=ends["closed_rad"])
      # Simulated arms have a busy machine, and nothing that they could hit.
      watchdog = core.limits.joint_age if robot.kind == "ur5e" else math.inf
      control = Control(
        arm, hand, core, board, events=events, clock=robot.clock, watchdog_s=watchdog
      )
      found = {"arm": arm.describe(), "gripper": gripper.describe()}
      board["devices"].write({name: json.dumps(x) for name, x in found.items()})
      gc.collect()
      gc.freeze()
      gc.disable()  # A collection could delay a cycle.
      try:
        _loop(control, robot.clock, peer)
      finally:
        control.close()
  except Exception as error:  # Whatever a driver raises ends the session with a line.
    with contextlib.suppress(OSError):
      events.send(reason(error))
  finally:
    board.close()


def _loop(control: Control, clock: Clock, peer: Connection) -> None:
  """Runs cycles until told to quit, and to rest if another process has ended."""
  parent = parent_process()
  poll = select.poll()
  for source in (peer.fileno(), *([int(parent.sentinel)] if parent else [])):
    poll.register(source, select.POLLIN | select.POLLHUP)
  ended, due, patience = "", clock.now(), REST_S
  while True:
    if not ended:
      for source, _ in poll.poll(0):
        mine = source == peer.fileno()
        ended = _last_words(peer) if mine else "session: the main process has ended"
    if ended:
      control.end_motion(ended)
    control.cycle()
    if control.phase is Phase.QUIT or (ended and control.phase is Phase.IDLE):
      if control.at_rest or patience < 0:
        return
      patience -= TIMESTEP
    due = max(due + TIMESTEP, clock.now() - TIMESTEP)  # Late cycles are left out.
    clock.sleep(due - clock.now())


def _last_words(peer: Connection) -> str:
  """Returns why the policy process has ended."""
  with contextlib.suppress(EOFError, OSError):
    return str(peer.recv())
  return "policy: its process has ended"
