"""A session: starts the processes of a robot, gives orders, and plays episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
from multiprocessing import get_context
import signal
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import INTERRUPTED, DeviceError, RunStopped
from apnpql_jax.robot import control_process, policy_process, simulated
from apnpql_jax.robot.board import Board, Phase
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.limits import Limits
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.supervisor import Mode

START_S = 600.0
"""Time that the processes may take to start; programs compile on first use."""

HOME_S = 60.0
"""Time of the session that the way to the neutral pose may take."""

SOLVED, TIME_LIMIT = "solved", "time limit"

_LOOK_S = 0.01  # Between two looks at the board.


@dataclasses.dataclass(frozen=True)
class Options:
  """How a session runs."""

  seed: int = 0
  """Random seed of the policy and of simulated reset states."""

  admittance: bool = True
  """Whether contacts move the virtual arm."""

  latency_s: float = 0.0
  """Delay of commands to a simulated arm, s."""

  log: str | None = None
  """Folder of the log to write."""

  replay: str | None = None
  """Log whose actions to repeat instead of the policy's."""


@dataclasses.dataclass(frozen=True)
class Outcome:
  """What became of an episode."""

  solved: bool | None
  """Whether the task was solved; None if no sensor can tell."""

  reason: str
  """solved, time limit, or why the arm stopped."""

  actions: int
  """Number of the policy's actions."""

  seconds: float
  """Duration."""

  events: list[tuple[float, str, str]]
  """Changes of the mode: time since the beginning in s, mode, reason."""

  @property
  def stopped(self) -> bool:
    """Whether a fault ended it."""
    return self.reason not in (SOLVED, TIME_LIMIT)


class Session(contextlib.AbstractContextManager):
  """The processes of a robot; leaving the context brings the arm to rest."""

  def __init__(
    self,
    robot: Robot,
    policy: PolicyFolder,
    options: Options,
    signals: Sequence[int] = (),
  ):
    """Starts the processes; ``wait_until_ready`` follows.

    All methods raise ``RunStopped`` as soon as there are ``signals``, a list that
    grows; leave the context then.
    """
    self._signals = signals
    self._policy, self._clock = policy, robot.clock
    self._judged = robot.kind == "simulated"
    self._number = self._scene = 0
    self._events: list[tuple[float, str, str]] = []
    self._failure = ""
    self._stack = contextlib.ExitStack()
    self._context = get_context("spawn")
    self.board = self._stack.enter_context(Board())
    self._plant: Board | None = None
    self.processes: dict[str, Any] = {}
    """Running processes by name: control and policy."""
    try:
      if self._judged:
        started = simulated.started(
          robot, seed=options.seed, latency_s=options.latency_s
        )
        robot = self._stack.enter_context(started)
        self._plant = self._stack.enter_context(simulated.opened(robot))
      self._start(robot, options)
    except BaseException:
      self.close()
      raise

  def __exit__(self, *error: object) -> None:
    self.close()

  def wait_until_ready(self) -> None:
    """Returns when devices and policy are ready.

    Raises:
      DeviceError: A process has ended, with its reason.
    """
    self._wait(self._is_ready, START_S, "the robot to get ready")

  def go_home(self) -> None:
    """Moves the arm to the neutral pose of the policy.

    A simulated arm that presses on something is freed first, as a person would do.

    Raises:
      DeviceError: It cannot get there, or a process has ended.
    """
    policy = self._policy
    force = np.linalg.norm(self.board["state"].read()["wrench"][:3])
    if self._plant is not None and force > Limits.hold_force:
      self._park(self._plant)
    self._order(Phase.HOME, target=policy.neutral, close=int(policy.begins_closed))
    self._wait(self._is_done, HOME_S * self._clock.slowdown, "the arm to go home")
    state = self.board["state"].read()
    if state["mode"] == Mode.STOP:
      raise DeviceError(
        f"the arm does not reach its neutral pose: {state['reason'].decode()}"
      )

  def play(self, watch: Callable[[Any], None] | None = None) -> Outcome:
    """Plays an episode from the neutral pose; ``watch`` gets the records "policy".

    Raises:
      DeviceError: A process has ended.
    """
    if self._plant is not None:
      self._new_scene(self._plant)
    self._take_events()
    self._events.clear()
    begin = self._clock.now()
    number = self._order(Phase.PLAY)

    def over() -> bool:
      policy = self.board["policy"].read()
      if watch is not None:
        watch(policy)
      return self._is_done() or bool(policy["order"] == number and policy["over"])

    limit = 2 * self._policy.contract["time_limit_s"] + 60
    self._wait(over, limit * self._clock.slowdown, "the episode to end")
    seconds = self._clock.now() - begin
    stopped = self._is_done()
    reason = self.board["state"].read()["reason"].decode() if stopped else ""

    def policy_ended() -> bool:
      """Returns true, too, if it has not begun, as after a stop in the first cycle."""
      policy = self.board["policy"].read()
      return policy["order"] != number or bool(policy["over"])

    self._wait(policy_ended, 60.0, "the policy to end")
    policy = self.board["policy"].read()
    played = policy["order"] == number
    self._order(Phase.IDLE)
    self._wait(self._is_obeyed, 10.0 * self._clock.slowdown, "the arm to rest")
    solved = bool(played and policy["solved"])
    self._take_events()
    return Outcome(
      solved=solved if self._judged else None,
      reason=reason or (SOLVED if solved else TIME_LIMIT),
      actions=int(policy["actions"]) if played else 0,
      seconds=seconds,
      events=[(t - begin, mode, why) for t, mode, why in self._events],
    )

  def close(self) -> None:
    """Brings the arm to rest and ends the processes."""
    if self.processes:
      self._order(Phase.QUIT)
    for name in ("control", "policy"):
      if name in self.processes:
        self.processes[name].join(10.0)
    for process in self.processes.values():
      process.join(2.0)
      if process.is_alive():
        process.kill()
        process.join()
    self.processes = {}
    self._stack.close()

  def _start(self, robot: Robot, options: Options) -> None:
    self._receiver, sender = self._context.Pipe(duplex=False)
    one, other = self._context.Pipe()
    about = {"admittance": options.admittance}
    self._spawn(
      "control", control_process.main, robot, self.board.name, about, sender, one
    )
    about = {
      "policy": str(self._policy.path),
      "seed": options.seed,
      "log": options.log,
      "replay": options.replay,
    }
    self._spawn("policy", policy_process.main, robot, self.board.name, about, other)
    for end in (sender, one, other):  # Each must be open in one process only.
      end.close()

  def _spawn(self, name: str, target: Callable[..., None], *args: Any) -> None:
    process = self._context.Process(target=target, args=args, name=name, daemon=True)
    process.start()
    self.processes[name] = process

  def _order(self, phase: Phase, **fields: Any) -> int:
    self._number += 1
    self.board["order"].write({"number": self._number, "phase": phase, **fields})
    return self._number

  def _new_scene(self, plant: Board) -> None:
    """Places the objects of the next reset state."""
    self._scene += 1
    plant["scene"].write({"number": self._scene})
    wait = 30.0 * self._clock.slowdown
    self._wait(
      lambda: plant["plant"].read()["scene"] == self._scene, wait, "the objects to rest"
    )

  def _park(self, plant: Board) -> None:
    """Puts a simulated arm back where it began."""
    number = plant["plant"].read()["parked"] + 1
    plant["scene"].write({"parked": number})
    wait = 30.0 * self._clock.slowdown
    self._wait(
      lambda: plant["plant"].read()["parked"] == number, wait, "the arm to be free"
    )

  def _is_ready(self) -> bool:
    state, policy = (self.board[x].read() for x in ("state", "policy"))
    return bool(state["time"] and policy["ready"])

  def _is_obeyed(self) -> bool:
    return bool(self.board["state"].read()["number"] == self._number)

  def _is_done(self) -> bool:
    state = self.board["state"].read()
    return bool(state["number"] == self._number and state["done"])

  def _wait(self, condition: Callable[[], bool], seconds: float, purpose: str) -> None:
    """Waits until a condition holds; raises ``DeviceError`` if a process fails."""
    until = time.monotonic() + seconds
    while not condition():
      self._check_processes()
      if time.monotonic() > until:
        raise DeviceError(f"robot: waited {seconds:.0f} s in vain for {purpose}")
      time.sleep(_LOOK_S)

  def _check_processes(self) -> None:
    self._take_events()
    if self._signals:
      name = signal.Signals(self._signals[0]).name
      raise RunStopped(f"{name}: the arm is at rest", INTERRUPTED + self._signals[0])
    failure = self._failure or self.board["policy"].read()["error"].decode()
    if not failure and self._plant is not None:
      failure = self._plant["plant"].read()["error"].decode()
    ended = [name for name, x in self.processes.items() if not x.is_alive()]
    if failure or ended:
      # The control process first brings the arm to rest.
      if "control" in self.processes:
        self.processes["control"].join(3.0 * self._clock.slowdown)
      self._take_events()
      raise DeviceError(failure or f"the {ended[0]} process has ended unexpectedly")

  def _take_events(self) -> None:
    """Collects what the control process has reported."""
    with contextlib.suppress(EOFError, OSError, AttributeError):
      while self._receiver.poll(0):
        event = self._receiver.recv()
        if isinstance(event, str):
          self._failure = self._failure or event
        else:
          self._events.append(event)
