"""The simulated robot: its arm and gripper, and the start of its process.

They are on the blackboard of the process, see ``process``; nothing here imports JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
from importlib.metadata import version
from multiprocessing import get_context
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.blackboard import Blackboard, text
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.orders import comes_true
from apnpql_jax.robot.protocols import ArmState, GripperState
from apnpql_jax.robot.simulated.process import CLOSE, HOLD, OPEN, RECORDS, main

_START_S = 120.0
"""Time that the plant may take to start, s; a busy machine imports slowly."""

_ZERO_S = 10.0
"""Time that the plant may take to zero its sensor, s."""


class _OnBoard:
  """A device whose measurements and commands are on the plant's board."""

  def __init__(self, plant: str):
    """Keeps the name of the board."""
    self._name = plant
    self._board: Blackboard | None = None

  def connect(self) -> None:
    """See ``Device.connect``."""
    self._board = Blackboard(self._name, RECORDS)

  def disconnect(self) -> None:
    """See ``Device.disconnect``."""
    if self._board is not None:
      self._board.close()
    self._board = None


class SimulatedArm(_OnBoard):
  """A simulated ``protocols.Arm``."""

  _zeroed = 0

  def describe(self) -> dict[str, Any]:
    """See ``Device.describe``."""
    return {"model": "simulated UR5e", "mujoco": version("mujoco")}

  def get_observation(self) -> ArmState:
    """See ``Arm.get_observation``."""
    found = _opened(self._board)["plant"].read()
    error = text(found["error"])
    if error:
      raise DeviceError(f"simulated arm: {error}")
    return ArmState(
      float(found["time"]), found["position"], found["velocity"], found["wrench"]
    )

  def send_action(self, position: np.ndarray) -> None:
    """See ``Arm.send_action``."""
    _opened(self._board)["servo"].write({"follow": 1, "target": position})

  def stop(self) -> None:
    """See ``Arm.stop``."""
    _opened(self._board)["servo"].write({"follow": 0})

  def start(self, *, zero: bool = True) -> None:
    """See ``Arm.start``."""
    board, position = _opened(self._board), self.get_observation().position
    self._zeroed += zero
    board["servo"].write({"follow": 1, "target": position, "zero": self._zeroed})
    if not self._comes_true(lambda: self._zeroed == board["plant"].read()["zeroed"]):
      raise DeviceError("simulated arm: it does not zero its sensor")

  def _comes_true(self, condition: Callable[[], bool]) -> bool:
    """Waits for the plant, whose measurements have the old zero until then."""
    return comes_true(condition, _ZERO_S)


class SimulatedGripper(_OnBoard):
  """A simulated ``protocols.Gripper``."""

  def describe(self) -> dict[str, Any]:
    """See ``Device.describe``."""
    return {"model": "simulated RH-P12-RN"}

  def get_observation(self) -> GripperState:
    """See ``Gripper.get_observation``."""
    found = _opened(self._board)["plant"].read()
    return GripperState(float(found["time"]), float(found["gripper"]))

  def send_action(self, close: bool) -> None:
    """See ``Gripper.send_action``."""
    _opened(self._board)["grip"].write({"command": CLOSE if close else OPEN})

  def hold(self) -> None:
    """See ``Gripper.hold``."""
    _opened(self._board)["grip"].write({"command": HOLD})


@contextlib.contextmanager
def started(
  robot: Robot,
  *,
  seed: int = 0,
  latency_s: float = 0.0,
  watch: Callable[[], None] = lambda: None,
) -> Generator[Robot]:
  """Starts the plant of a simulated robot and yields how to open it; others as given.

  Args:
    robot: The robot.
    seed: Random seed of reset states and noise.
    latency_s: Delay of commands, s.
    watch: Is called while the plant starts; what it raises ends that.

  Raises:
    DeviceError: The plant does not start, or takes too long.
  """
  if robot.kind != "simulated" or robot.plant:
    yield robot
    return
  settings = {"seed": seed, "latency_s": latency_s, "clock": robot.clock}
  with Blackboard(records=RECORDS) as board:
    process = get_context("spawn").Process(
      target=main, args=(board.name, robot.contract["task"], settings), daemon=True
    )
    process.start()

    def is_ready() -> bool:
      watch()
      error = text(board["plant"].read()["error"])
      if error or not process.is_alive():
        raise DeviceError(f"simulated robot: {error or 'it does not start'}")
      return bool(board["plant"].read()["ready"])

    try:
      if not comes_true(is_ready, _START_S):
        raise DeviceError(f"simulated robot: it is not ready after {_START_S:g} s")
      yield dataclasses.replace(robot, plant=board.name)
    finally:
      board["scene"].write({"quit": 1})
      process.join(5.0)
      process.kill()


@contextlib.contextmanager
def opened(robot: Robot) -> Generator[Blackboard]:
  """Yields the board of a started plant, to place its objects."""
  with Blackboard(robot.plant, RECORDS) as board:
    yield board


class Operator:
  """The help that an operator gives a real arm, for a started plant."""

  def __init__(
    self, board: Blackboard, wait: Callable[[Callable[[], bool], str], None]
  ):
    """Keeps the plant's board; ``wait`` waits for a condition, which has a name."""
    self._board, self._wait = board, wait
    self._scene = 0

  @property
  def error(self) -> str:
    """Why the plant has ended, if it has."""
    return text(self._board["plant"].read()["error"])

  def place_objects(self) -> None:
    """Places the objects of the next reset state."""
    self._scene += 1
    self._board["scene"].write({"number": self._scene})
    self._wait(
      lambda: self._board["plant"].read()["scene"] == self._scene, "the objects to rest"
    )

  def free_arm(self) -> None:
    """Puts the arm back where it began."""
    number = self._board["plant"].read()["parked"] + 1
    self._board["scene"].write({"parked": number})
    self._wait(
      lambda: self._board["plant"].read()["parked"] == number, "the arm to be free"
    )


def _opened(board: Blackboard | None) -> Blackboard:
  if board is None:
    raise DeviceError("simulated robot: not connected")
  return board
