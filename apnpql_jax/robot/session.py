"""A session: the processes of a robot, orders to them, and episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
import functools
import signal
from typing import Any, Self

import numpy as np

from apnpql_jax.errors import INTERRUPTED, DeviceError, RunStopped
from apnpql_jax.robot import policy_process
from apnpql_jax.robot.blackboard import PERIOD_BIN_S, Blackboard, Phase, text
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.episodes import SOLVED, TIME_LIMIT, Homing, Options, Outcome
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.orders import Orders, comes_true
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.processes import Processes
from apnpql_jax.robot.simulated import devices as simulated
from apnpql_jax.robot.supervisor import Mode

START_S = 600.0
"""Time that the processes may take to start; programs compile on first use."""

HOME_S = 60.0
"""Longest time of a motion to the neutral pose, or of an operator's help, s."""

REST_S = 10.0
"""Time that the arm may take to come to rest, s."""

UNKNOWN = "the arm's controller holds; its state is unknown"


class Session(contextlib.AbstractContextManager):
  """The processes of a robot; leaving the context brings the arm to rest."""

  def __init__(
    self,
    robot: Robot,
    policy: PolicyFolder,
    options: Options,
    signals: Sequence[int] = (),
  ):
    """Prepares the session; entering the context starts its processes.

    Methods raise ``RunStopped`` as soon as there are ``signals``, a list that grows;
    leave the context then.
    """
    self._signals = signals
    self._robot, self._policy, self._options = robot, policy, options
    self._clock = robot.clock
    self._events: list[tuple[float, str, str]] = []
    self._failure, self._moved = "", False
    self.rest = "the arm has not moved"
    """What is known about the arm after ``close``."""
    self._stack = contextlib.ExitStack()
    self.board = self._stack.enter_context(Blackboard())
    self._orders = Orders(self.board)
    self._operator: simulated.Operator | None = None
    self.homing = Homing()
    """Outcome of the last ``go_home``."""
    self.processes: Processes | None = None
    """The control and the policy process."""

  def __enter__(self) -> Self:
    """Starts the processes; ``wait_until_ready`` follows.

    Raises:
      DeviceError: The simulated robot does not start.
    """
    try:
      self._start(self._robot, self._options)
    except BaseException:
      self.close()
      raise
    return self

  def __exit__(self, *error: object) -> None:
    self.close()

  def wait_until_ready(self) -> None:
    """Returns when devices and policy are ready.

    Raises:
      DeviceError: A process has ended, with its reason.
    """
    self._wait(self._is_ready, "the robot to get ready", START_S)

  def go_home(self) -> None:
    """Moves the arm to the neutral pose of the policy, and the gripper as it begins.

    There, the force sensor must read what a free hand may. A simulated robot that does
    not get there is reset, as an operator would free it, and tries again. ``homing`` is
    what came of it, also after an error.

    Raises:
      DeviceError: It cannot get there, or a process has ended.
    """
    self.homing = Homing()
    reason = self._try_to_go_home()
    if reason and self._operator is not None:
      self.homing = Homing(reset_reason=reason)
      self._operator.free_arm()
      self._operator.place_objects()
      reason = self._try_to_go_home()
    if reason:
      raise DeviceError(f"the arm is not home: {reason}")

  def play(self, watch: Callable[[Any], None] | None = None) -> Outcome:
    """Plays an episode from the neutral pose; ``watch`` gets the records "policy".

    A signal, or what fails meanwhile, ends it as well and is its reason. ``check`` then
    raises it.

    Raises:
      DeviceError: A process has ended before the episode.
    """
    if self._operator is not None:
      self._operator.place_objects()
    self._take_events()
    self._events.clear()
    begin, overruns = self._clock.now(), self._overruns()
    number = self._orders.give(Phase.PLAY)
    reason, whole = self._follow(number, watch)
    seconds = self._clock.now() - begin
    policy = self._ended(number)
    self._take_events()
    solved = bool(policy["solved"])
    judged = whole and not self._failure and self._robot.can_judge and policy["actions"]
    return Outcome(
      solved=solved if judged else None,
      reason=reason or (SOLVED if solved else TIME_LIMIT),
      actions=int(policy["actions"]),
      seconds=seconds,
      events=[(t - begin, mode, why) for t, mode, why in self._events],
      missed_periods=int(policy["missed"]),
      overruns=self._overruns() - overruns,
      dataset_index=int(policy["index"]) if policy["index"] >= 0 else None,
      homing_before=self.homing,
    )

  def check(self) -> None:
    """Raises what has ended the session: a signal or a failure.

    Raises:
      RunStopped: There was a signal, which is the message.
      DeviceError: A device or process has failed, with its reason.
    """
    self._take_events()
    self._check_signals()
    failure = self._failure or text(self.board["policy"].read()["error"])
    if not failure and self._operator is not None:
      failure = self._operator.error
    ended = self._running.ended
    if failure or ended:
      # The control process first brings the arm to rest.
      self._running.join("control", 3.0 * self._clock.slowdown)
      self._take_events()
      self._failure = failure = self._failure or failure
      raise DeviceError(failure or f"the {ended[0]} process has ended unexpectedly")

  def close(self) -> None:
    """Brings the arm to rest and ends the processes; ``rest`` is what came of it."""
    if self.processes is not None:
      self._orders.give(Phase.QUIT)
      self.processes.join("control", REST_S * self._clock.slowdown)
      if self._moved:
        known = not self.processes.is_alive("control")
        at_rest = known and self.board["state"].read()["at_rest"]
        self.rest = "the arm is at rest" if at_rest else UNKNOWN
      self.processes.end(0.0, policy_process.END_S)
      self.processes = None
    self._stack.close()

  def _start(self, robot: Robot, options: Options) -> None:
    if robot.kind == "simulated":
      started = simulated.started(
        robot, seed=options.seed, latency_s=options.latency_s, watch=self._check_signals
      )
      robot = self._stack.enter_context(started)
      plant = self._stack.enter_context(simulated.opened(robot))
      wait = functools.partial(self._wait, seconds=HOME_S * self._clock.slowdown)
      self._operator = simulated.Operator(plant, wait)
    self.processes = Processes(
      robot,
      self.board.name,
      control={"admittance": options.admittance},
      policy={
        "policy": str(self._policy.path),
        "seed": options.seed,
        "log": options.log,
        "replay": options.replay,
      },
    )

  def _check_signals(self) -> None:
    if self._signals:
      name = signal.Signals(self._signals[0]).name
      raise RunStopped(name, INTERRUPTED + self._signals[0])

  def _try_to_go_home(self) -> str:
    """Returns why the robot is not home, or an empty string; see ``go_home``."""
    target, close = self._policy.neutral, int(self._policy.begins_closed)
    self._moved = True
    self._orders.give(Phase.HOME, target=target, close=close)
    wait = HOME_S * self._clock.slowdown
    self._wait(lambda: self._orders.done, "the arm to go home", wait)
    state = self.board["state"].read()
    if np.isfinite(state["unloaded"]).all():
      wrench = state["unloaded"].tolist()
      self.homing = dataclasses.replace(self.homing, unloaded_wrench=wrench)
    return text(state["reason"]) if state["mode"] == Mode.STOP else ""

  def _is_ready(self) -> bool:
    state, policy = (self.board[x].read() for x in ("state", "policy"))
    return bool(state["time"] and policy["ready"])

  def _follow(
    self, number: int, watch: Callable[[Any], None] | None
  ) -> tuple[str, bool]:
    """Waits for the end of an episode.

    Returns:
      Why it ended early, or an empty string; and whether the episode itself ended,
      rather than a signal or a failure ending it.
    """

    def over() -> bool:
      policy = self.board["policy"].read()
      if watch is not None:
        watch(policy)
      return self._orders.done or bool(policy["order"] == number and policy["over"])

    limit = 2 * self._policy.contract["time_limit_s"] + 60
    try:
      self._wait(over, "the episode to end", limit * self._clock.slowdown)
    except (DeviceError, RunStopped) as error:
      return str(error), False
    reason = text(self.board["state"].read()["reason"]) if self._orders.done else ""
    failed = self._running.ended or text(self.board["policy"].read()["error"])
    return reason, not failed

  def _ended(self, number: int) -> Any:
    """Brings the arm to rest; returns the record "policy" once the episode is written.

    The record is empty if the episode did not begin for the policy.
    """
    self._orders.give(Phase.IDLE)
    if not comes_true(
      lambda: self._orders.obeyed or not self._running.is_alive("control"),
      REST_S * self._clock.slowdown,
    ):
      self._failure = self._failure or "robot: the arm does not come to rest"

    def written() -> bool:
      found = self.board["policy"].read()
      begun = found["order"] == number and self._running.is_alive("policy")
      return not begun or found["ended"] == number

    if not comes_true(written, policy_process.END_S):
      self._failure = self._failure or "policy: it does not end its episode"
    found = self.board["policy"].read()
    none = dict.fromkeys(("actions", "missed", "solved"), 0) | {"index": -1}
    return found if found["order"] == number else none

  def _overruns(self) -> int:
    """Returns how many cycles have been late so far."""
    late = round(2 * TIMESTEP / PERIOD_BIN_S)
    return int(self.board["state"].read()["periods"][late:].sum())

  def _wait(self, condition: Callable[[], bool], purpose: str, seconds: float) -> None:
    """Waits until a condition holds; raises what ``check`` raises."""

    def met() -> bool:
      if condition():
        return True
      self.check()
      return False

    if not comes_true(met, seconds):
      self._failure = f"robot: waited {seconds:.0f} s in vain for {purpose}"
      raise DeviceError(self._failure)

  def _take_events(self) -> None:
    """Collects what the control process has reported."""
    for event in self._running.events():
      if isinstance(event, str):
        self._failure = self._failure or event
      else:
        self._events.append(event)

  @property
  def _running(self) -> Processes:
    assert self.processes is not None
    return self.processes
