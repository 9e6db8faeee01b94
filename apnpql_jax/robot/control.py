"""A cycle of the control process: orders, devices, and the command to the arm.

The process itself, with its clock and its end, is in ``control_process``.
"""

from __future__ import annotations

import contextlib
from multiprocessing.connection import Connection

import numpy as np

from apnpql_jax.robot.blackboard import PERIOD_BIN_S, PERIOD_BINS, Blackboard, Phase
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.core import Command, Core
from apnpql_jax.robot.hand import Hand
from apnpql_jax.robot.protocols import Arm, ArmState
from apnpql_jax.robot.supervisor import Action, Mode
from apnpql_jax.robot.zero import Zero

GRIP_S = 3.0
"""Time that the gripper may take to open or close before an episode, s; 1.4 s for all
of its way at the speed of the training."""

REST_RAD_S = 0.01
"""Joint velocity below which the arm is at rest, rad/s; above the noise of a UR5e."""


class Control:
  """Control of the devices that it is given, cycle by cycle."""

  def __init__(
    self,
    arm: Arm,
    hand: Hand,
    core: Core,
    board: Blackboard,
    *,
    events: Connection | None = None,
    clock: Clock | None = None,
    watchdog_s: float = np.inf,
  ):
    """Keeps what it acts on.

    Args:
      arm: The arm, connected.
      hand: The gripper.
      core: What turns measurements and actions into commands.
      board: The board.
      events: Gets (time, mode, reason) at each change.
      clock: The clock of the session.
      watchdog_s: Longest time between two cycles; after a longer one, a motion ends.
    """
    self._arm, self._hand, self._core, self._board = arm, hand, core, board
    self._events, self._clock = events, clock or Clock()
    self._watchdog = watchdog_s
    self._number, self._phase, self._done = 0, Phase.IDLE, False
    self._began = 0.0
    self._target, self._closed = np.zeros(6), False
    self._told, self._ending = (Mode.FOLLOW, ""), ""
    self._last, self._periods = 0.0, np.zeros(PERIOD_BINS, int)
    self._zero = Zero()
    self.at_rest = False
    """Whether the arm follows no commands, and its measured joints stand still."""

  @property
  def phase(self) -> Phase:
    """The present phase."""
    return self._phase

  def end_motion(self, reason: str) -> None:
    """Brakes; the first reason stays."""
    self._ending = self._ending or reason

  def cycle(self) -> None:
    """Reads the devices and the board, commands the arm, and publishes the state."""
    self._obey()
    state, now = self._arm.get_observation(), self._clock.now()
    self._note_period(now)
    self._zero.note(state.wrench)
    self._hand.look(now)
    if self._is_moving:
      self._move(now, state)
    age = self._core.limits.joint_age
    still = np.abs(state.velocity).max() < REST_RAD_S and now - state.time <= age
    self.at_rest = bool(not self._is_moving and still)
    self._publish(state)

  def close(self) -> None:
    """Stops the fingers, and brakes if the arm moves."""
    self._hand.hold(self._clock.now())  # First: the arm may take a while.
    with contextlib.suppress(Exception):
      self._arm.stop()

  @property
  def _is_moving(self) -> bool:
    return self._phase in (Phase.HOME, Phase.PLAY)

  def _move(self, now: float, state: ArmState) -> None:
    """Commands arm and gripper; an arm at its goal, or stopped, comes to rest."""
    supervisor = self._core.supervisor
    if reason := self._ending or self._hand.error:
      supervisor.stop(reason)
    supervisor.check_gripper(now, self._hand.state)
    home = self._phase is Phase.HOME
    command = self._go_home(now, state) if home else self._play(now, state)
    self._tell(now, command)  # First: an arm with a fault takes no command.
    stopped = command.mode is Mode.STOP
    if stopped:
      self._hand.hold(now)
    ended = stopped and (command.at_rest or state.fault)
    if ended or (home and self._ends_home(command, state)):
      self._rest()
    else:
      self._arm.send_action(command.position)

  def _play(self, now: float, state: ArmState) -> Command:
    action = self._action()
    command = self._core.step(now, state, action)
    if command.mode is Mode.FOLLOW and action is not None:
      self._hand.move(now, bool(action.values[6] > 0.5))
    return command

  def _go_home(self, now: float, state: ArmState) -> Command:
    """Moves the gripper only if the arm may move."""
    core, hand = self._core, self._hand
    command = core.move(now, state, self._target)
    if command.mode is Mode.FOLLOW:
      hand.move(now, self._closed)
      waited = now - max(hand.since, self._began) > GRIP_S
      arrived = core.has_arrived(self._target)
      if waited and arrived and not hand.is_at(self._closed):
        angle = hand.state.angle
        core.supervisor.stop(f"gripper: still at {angle:.2f} rad after {GRIP_S:g} s")
    return command

  def _ends_home(self, command: Command, state: ArmState) -> bool:
    """Checks the force sensor of a robot at home; returns whether an episode may begin.

    Only readings of a robot at rest count. A sensor that is wrong stops the motion.
    """
    if not self._is_home(command, state):
      self._zero.forget()
      return False
    if not self._zero.is_sure:
      return False
    refusal = self._zero.check()
    self._core.supervisor.stop(refusal)
    return not refusal

  def _is_home(self, command: Command, state: ArmState) -> bool:
    """Returns whether arm and gripper rest as an episode begins."""
    arrived = command.mode is Mode.FOLLOW and self._core.has_arrived(self._target)
    still = np.abs(state.velocity).max() < REST_RAD_S
    return bool(arrived and still and self._hand.is_at(self._closed))

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
    if self._is_moving:
      self.end_motion("session: the episode is over")  # First to rest, then onwards.
      return
    self._number, self._phase = int(order["number"]), Phase(int(order["phase"]))
    self._done, self._ending, self._told = False, "", (Mode.FOLLOW, "")
    if self._is_moving:
      self._target, self._closed = order["target"].copy(), bool(order["close"])
      home = self._phase is Phase.HOME
      refusal = self._zero.start(self._arm, again=not home)
      goal = self._target if home else None
      self._began = self._clock.now()
      self._core.start(self._began, self._arm.get_observation(), goal)
      self._core.supervisor.stop(refusal)
      self._last = 0.0

  def _rest(self) -> None:
    """Ends the motion of a command that is at rest."""
    self._arm.stop()
    self._phase, self._done, self._last = Phase.IDLE, True, 0.0

  def _tell(self, now: float, command: Command) -> None:
    told = command.mode, command.reason
    if told == self._told:
      return
    self._told = told
    if self._events is not None:
      with contextlib.suppress(OSError):
        self._events.send((now, command.mode.name.lower(), command.reason))

  def _note_period(self, now: float) -> None:
    """Counts the time since the last cycle, unless that cycle has waited for the arm.

    After a long one, the arm is at rest at its last command, or nearly so. So the next
    command must not go on at the former speed.
    """
    step = now - self._last if self._last else 0.0
    if self._last:
      self._periods[int(min(step / PERIOD_BIN_S, PERIOD_BINS - 1))] += 1
    if self._is_moving and step > self._watchdog:
      self._core.limiter.halt()
      self._core.supervisor.stop(f"control: {1e3 * step:.0f} ms without a cycle")
    self._last = now

  def _publish(self, state: ArmState) -> None:
    self._board["state"].write(
      {
        "number": self._number,
        "phase": self._phase,
        "time": state.time,
        "position": state.position,
        "velocity": state.velocity,
        "wrench": state.wrench,
        "command": self._core.limiter.position,
        "gripper": self._hand.state.angle,
        "gripper_time": self._hand.state.time,
        "mode": self._told[0],
        "reason": self._told[1],
        "done": self._done,
        "at_rest": self.at_rest,
        "unloaded": self._zero.unloaded,
        "periods": self._periods,
      }
    )
