"""The control process: 500 cycles per second between the devices and the board.

It does not import JAX, so that neither a compilation nor a thread pool can delay it.
Its end ends the policy process. It brakes when that or the main process ends.
"""

from __future__ import annotations

import contextlib
import gc
from multiprocessing import connection, parent_process
import os
import select
import sys
import threading

import numpy as np

from apnpql_jax.robot import devices
from apnpql_jax.robot.board import PERIOD_BIN_S, PERIOD_BINS, Board, Phase
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.core import Command, Core
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import Arm, ArmState, Gripper
from apnpql_jax.robot.supervisor import Action, Mode
from apnpql_jax.robot.zero import Zero

GRIPPER_CYCLE_S = 0.03
"""Time between messages to the gripper, whose line is slow."""

REALTIME_PRIORITY = 20
"""Priority of the process for a real arm, if the system grants it."""

Pipe = connection.Connection


class GripperThread(threading.Thread):
  """Talks with the gripper, so that its slow line does not delay the arm."""

  def __init__(self, gripper: Gripper):
    """Reads the first state."""
    super().__init__(daemon=True)
    self._gripper, self._sent, self._over = gripper, None, threading.Event()
    self.close: bool | None = None
    """What the gripper is to do, or None to leave it as it is."""
    self.angle, self.error = gripper.get_observation().angle, ""

  def run(self) -> None:
    """Passes on commands and measurements until ``end``."""
    try:
      while not self._over.wait(GRIPPER_CYCLE_S):
        if self.close is not None and self.close != self._sent:
          self._gripper.send_action(self.close)
          self._sent = self.close
        self.angle = self._gripper.get_observation().angle
    except Exception as error:  # Whatever the driver raises stops the episode.
      self.error = f"gripper: {devices.reason(error)}"

  def end(self) -> None:
    """Stops the thread."""
    self._over.set()
    self.join(1.0)


class Controller:
  """The cycle of the control process, with the devices it is given."""

  def __init__(
    self,
    arm: Arm,
    gripper: Gripper,
    core: Core,
    board: Board,
    *,
    events: Pipe | None = None,
    clock: Clock | None = None,
  ):
    """Keeps the devices; ``events`` gets (time, mode, reason) at each change."""
    self._arm, self._core, self._board, self._events = arm, core, board, events
    self._clock = clock or Clock()
    self._gripper = GripperThread(gripper)
    self._gripper.start()
    self._number, self._phase, self._done = 0, Phase.IDLE, False
    self._target, self._told = np.zeros(6), (Mode.FOLLOW, "")
    self._ending, self._last = "", 0.0
    self._periods = np.zeros(PERIOD_BINS, int)
    self._zero = Zero()

  @property
  def phase(self) -> Phase:
    """What it does."""
    return self._phase

  def end_motion(self, reason: str) -> None:
    """Brakes; the first reason stays."""
    self._ending = self._ending or reason

  def cycle(self) -> None:
    """Reads the devices and the board, commands the arm, and publishes the state."""
    self._obey()
    state, now = self._arm.get_observation(), self._clock.now()
    self._zero.note(state.wrench)
    step = (now - self._last) / PERIOD_BIN_S
    self._periods[int(min(step, PERIOD_BINS - 1))] += 1
    self._last = now
    command = self._command(now, state)
    if command is not None:
      self._tell(now, command)  # First: an arm with a fault takes no command.
      if command.mode is Mode.STOP and (command.at_rest or state.fault):
        self._rest()
      else:
        self._arm.send_action(command.position)
    self._board["state"].write(
      {
        "number": self._number,
        "phase": self._phase,
        "time": state.time,
        "position": state.position,
        "velocity": state.velocity,
        "wrench": state.wrench,
        "command": self._core.limiter.position,
        "gripper": self._gripper.angle,
        "mode": self._told[0],
        "reason": self._told[1],
        "done": self._done,
        "periods": self._periods,
      }
    )

  def close(self) -> None:
    """Brakes if the arm moves, and ends the gripper's thread."""
    with contextlib.suppress(Exception):
      self._arm.stop()
    self._gripper.end()

  def _command(self, now: float, state: ArmState) -> Command | None:
    """Returns the outcome of the cycle; None if the arm does not follow commands."""
    core = self._core
    if self._phase not in (Phase.HOME, Phase.PLAY):
      return None
    if self._ending or self._gripper.error:
      core.supervisor.stop(self._ending or self._gripper.error)
    if self._phase is Phase.HOME:
      command = core.move(now, state, self._target)
      if core.has_arrived(self._target) and command.mode is Mode.FOLLOW:
        self._rest()
        return None
      return command
    action = self._action()
    command = core.step(now, state, action)
    if command.mode is Mode.FOLLOW and action is not None:
      self._gripper.close = bool(action.values[6] > 0.5)
    return command

  def _action(self) -> Action | None:
    """Returns the policy's newest action of this episode, if there is one."""
    found = self._board["action"].read()
    if found["order"] != self._number or not found["number"]:
      return None
    return Action(
      int(found["number"]), float(found["time"]), found["values"], found["frames"]
    )

  def _obey(self) -> None:
    """Follows a new order of the main process."""
    order = self._board["order"].read()
    if order["number"] == self._number:
      return
    if self._phase in (Phase.HOME, Phase.PLAY):
      self.end_motion("session: the episode is over")  # First to rest, then onwards.
      return
    self._number, self._phase = int(order["number"]), Phase(int(order["phase"]))
    self._done, self._ending, self._told = False, "", (Mode.FOLLOW, "")
    if self._phase in (Phase.HOME, Phase.PLAY):
      self._target = order["target"].copy()
      if self._phase is Phase.HOME:
        self._gripper.close = bool(order["close"])
      refusal = self._zero.start(self._arm, again=self._phase is Phase.PLAY)
      goal = self._target if self._phase is Phase.HOME else None
      self._core.start(self._clock.now(), self._arm.get_observation(), goal)
      self._core.supervisor.stop(refusal)

  def _rest(self) -> None:
    """Ends the motion of a command that is at rest."""
    self._arm.stop()
    self._phase, self._done = Phase.IDLE, True

  def _tell(self, now: float, command: Command) -> None:
    told = command.mode, command.reason
    if told == self._told:
      return
    self._told = told
    if self._events is not None:
      with contextlib.suppress(OSError):
        self._events.send((now, command.mode.name.lower(), command.reason))


def main(
  robot: Robot, board_name: str, options: dict, events: Pipe, peer: Pipe
) -> None:
  """Runs the process.

  Args:
    robot: What to open.
    board_name: Name of the board.
    options: ``admittance``: whether contacts move the virtual arm.
    events: Gets changes of the mode, and an error that ends the process, as text.
    peer: Its other end is with the policy process alone.
  """
  devices.leave_interrupts_to_the_main_process()
  # More often than every 5 ms, so that the gripper's thread does not hold up cycles.
  sys.setswitchinterval(5e-4)
  board = Board(board_name)
  admittance = robot.cell.admittance() if options["admittance"] else None
  core = Core(robot.cell.limits(robot.contract), admittance=admittance)
  try:
    with devices.open_arm(robot) as (arm, gripper):
      if robot.kind == "ur5e":
        _ask_for_priority()
      controller = Controller(
        arm, gripper, core, board, events=events, clock=robot.clock
      )
      gc.collect()
      gc.freeze()
      gc.disable()  # A collection could delay a cycle.
      try:
        _loop(controller, robot.clock, peer)
      finally:
        controller.close()
  except Exception as error:  # Whatever a driver raises ends the session with a line.
    with contextlib.suppress(OSError):
      events.send(devices.reason(error))
  finally:
    board.close()


def _loop(controller: Controller, clock: Clock, peer: Pipe) -> None:
  """Runs cycles until told to quit, and to rest if another process has ended."""
  parent = parent_process()
  ends = {peer.fileno(): "policy: its process has ended"}
  if parent is not None:
    ends[int(parent.sentinel)] = "session: the main process has ended"
  poll = select.poll()
  for number in ends:
    poll.register(number, select.POLLIN | select.POLLHUP)
  ended, due = "", clock.now()
  while True:
    if not ended:
      for number, _ in poll.poll(0):
        ended = ended or ends[number]
    if ended:
      controller.end_motion(ended)
    controller.cycle()
    if controller.phase is Phase.QUIT or (ended and controller.phase is Phase.IDLE):
      return
    due = max(due + TIMESTEP, clock.now() - TIMESTEP)  # Late cycles are left out.
    clock.sleep(due - clock.now())


def _ask_for_priority() -> None:
  with contextlib.suppress(OSError, AttributeError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
