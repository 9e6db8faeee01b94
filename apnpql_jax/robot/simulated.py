"""The simulated robot: a ``Plant`` in a process of its own, and its arm and gripper.

The process draws the reset states of the task, so it imports the task and with it JAX,
but it runs nothing in JAX. The devices of this module import neither.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import dataclasses
import importlib
from multiprocessing import get_context, parent_process
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import devices
from apnpql_jax.robot.board import TEXT, Board
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.plant import Plant, Servo
from apnpql_jax.robot.protocols import ArmState, GripperState

_MOST = {"qpos": 128, "qvel": 128, "mocap_pos": 24, "mocap_quat": 32}
"""Room for arrays of the scene."""

RECORDS = {
  # From the plant: its whole state, see ``Scene``.
  "plant": [
    ("ready", "i8"),
    ("scene", "i8"),
    ("parked", "i8"),
    ("time", "f8"),
    ("position", "f8", 6),
    ("velocity", "f8", 6),
    ("wrench", "f8", 6),
    ("gripper", "f8"),
    ("zeroed", "i8"),
    ("variant", "i8"),
    ("error", TEXT),
    *((name, "f8", size) for name, size in _MOST.items()),
  ],
  "servo": [("follow", "i8"), ("target", "f8", 6), ("zero", "i8")],
  "grip": [("close", "i8")],
  # From the main process: the number of the reset state to show, and how often the arm
  # was to be put back where it began.
  "scene": [("number", "i8"), ("parked", "i8"), ("quit", "i8")],
}

_CATCH_UP_S = 0.02
"""Delay that the plant makes up for; a longer one lets its time stand still."""

_SETTLE_S = 0.5
"""Time for which new objects come to rest."""

PARKED = np.array([0.15, 0.1, -0.1, 0.1, 0.05, -0.1])
"""Where the arm begins, rad from the neutral pose, so that it has to go there."""


class _OnBoard:
  """A device whose measurements and commands are on the plant's board."""

  def __init__(self, plant: str):
    """Keeps the name of the board."""
    self._name = plant
    self._board: Board | None = None

  def connect(self) -> None:
    """See ``Device.connect``."""
    self._board = Board(self._name, RECORDS)

  def disconnect(self) -> None:
    """See ``Device.disconnect``."""
    if self._board is not None:
      self._board.close()
    self._board = None


class SimulatedArm(_OnBoard):
  """See ``protocols.Arm``."""

  _zeroed = 0

  def describe(self) -> dict[str, Any]:
    """See ``Device.describe``."""
    return {"model": "simulated UR5e"}

  def get_observation(self) -> ArmState:
    """See ``Arm.get_observation``."""
    found = _opened(self._board)["plant"].read()
    error = found["error"].decode()
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
    position = self.get_observation().position
    self._zeroed += zero
    _opened(self._board)["servo"].write(
      {"follow": 1, "target": position, "zero": self._zeroed}
    )


class SimulatedGripper(_OnBoard):
  """See ``protocols.Gripper``."""

  def describe(self) -> dict[str, Any]:
    """See ``Device.describe``."""
    return {"model": "simulated RH-P12-RN"}

  def get_observation(self) -> GripperState:
    """See ``Gripper.get_observation``."""
    found = _opened(self._board)["plant"].read()
    return GripperState(float(found["time"]), float(found["gripper"]))

  def send_action(self, close: bool) -> None:
    """See ``Gripper.send_action``."""
    _opened(self._board)["grip"].write({"close": int(close)})


@contextlib.contextmanager
def started(robot: Robot, *, seed: int = 0, latency_s: float = 0.0) -> Generator[Robot]:
  """Starts the plant of a simulated robot and yields how to open it; others as given.

  Args:
    robot: The robot.
    seed: Random seed of reset states and noise.
    latency_s: Delay of commands, s.

  Raises:
    DeviceError: The plant does not start.
  """
  if robot.kind != "simulated" or robot.plant:
    yield robot
    return
  settings = {"seed": seed, "latency_s": latency_s, "clock": robot.clock}
  with Board(records=RECORDS) as board:
    process = get_context("spawn").Process(
      target=main, args=(board.name, robot.contract["task"], settings), daemon=True
    )
    process.start()
    try:
      while not board["plant"].read()["ready"]:
        error = board["plant"].read()["error"].decode()
        if error or not process.is_alive():
          raise DeviceError(f"simulated robot: {error or 'it does not start'}")
        time.sleep(0.01)
      yield dataclasses.replace(robot, plant=board.name)
    finally:
      board["scene"].write({"quit": 1})
      process.join(5.0)
      process.kill()


@contextlib.contextmanager
def opened(robot: Robot) -> Generator[Board]:
  """Yields the board of a started plant, to place its objects."""
  with Board(robot.plant, RECORDS) as board:
    yield board


def _opened(board: Board | None) -> Board:
  if board is None:
    raise DeviceError("simulated robot: not connected")
  return board


class Scene:
  """A task's objects: reset states that are placed in the plant, and its state."""

  def __init__(self, task: Any, *, seed: int):
    """Keeps a ``tasks.Task``."""
    self._task, self._rng = task, np.random.default_rng(seed)

  def place(self, plant: Plant) -> int:
    """Draws a reset state, places it, and returns the variant of its objects."""
    draw = self._task.sample_resets(self._rng, 1)
    variant = int(draw.variant[0])
    for name, values in self._task.scene.variants.items():
      getattr(plant.model, name)[...] = values[variant]
    plant.place(draw.qpos[0], draw.mocap_pos[0], draw.mocap_quat[0])
    return variant

  def park(self, plant: Plant) -> None:
    """Puts the arm near the neutral pose, as a person would free it."""
    scene = self._task.scene
    plant.put_arm(scene.keyframe("neutral")[scene.arm_qpos] + PARKED)

  @staticmethod
  def state_of(plant: Plant) -> dict[str, np.ndarray]:
    """Returns the arrays of ``_MOST``, padded."""
    found = {}
    for name, size in _MOST.items():
      values = np.asarray(getattr(plant.data, name)).reshape(-1)
      found[name] = np.pad(values, (0, size - len(values)))
    return found


def main(name: str, task_name: str, options: dict[str, Any]) -> None:
  """Runs the process of the plant.

  Args:
    name: Name of its board, with ``RECORDS``.
    task_name: Name of the task.
    options: ``seed`` of the reset states, ``latency_s``, ``clock``.
  """
  devices.leave_interrupts_to_the_main_process()
  board = Board(name, RECORDS)
  try:
    tasks = importlib.import_module("apnpql_jax.tasks")
    task = tasks.make_task(task_name)
    servo = Servo(latency_s=options["latency_s"])
    plant = Plant(task.scene.model, servo, seed=options["seed"])
    _run(board, plant, Scene(task, seed=options["seed"]), options["clock"])
  except Exception as error:  # Shown by the main process, which ends the session.
    with contextlib.suppress(Exception):
      board["plant"].write({"error": devices.reason(error)})
  finally:
    board.close()


def _run(board: Board, plant: Plant, scene: Scene, clock: Clock) -> None:
  parent, shown, zeroed, variant, since = parent_process(), 0, 0, 0, 0.0
  parked = 0
  scene.park(plant)
  due = clock.now()
  while parent is None or parent.is_alive():
    servo, grip, order = (board[x].read() for x in ("servo", "grip", "scene"))
    if order["quit"]:
      return
    if order["number"] != shown:
      variant, shown, since = scene.place(plant), int(order["number"]), clock.now()
    if order["parked"] != parked:
      parked = int(order["parked"])
      scene.park(plant)
    if servo["zero"] != zeroed:
      zeroed = int(servo["zero"])
      plant.zero_force()
    while due <= clock.now():
      plant.step(servo["target"] if servo["follow"] else None, bool(grip["close"]))
      due = max(due + TIMESTEP, clock.now() - _CATCH_UP_S)
    now = clock.now()
    state, settled = plant.arm_state(now), now - since > _SETTLE_S
    board["plant"].write(
      {
        "ready": 1,
        "scene": shown if settled else 0,
        "parked": parked,
        "time": state.time,
        "position": state.position,
        "velocity": state.velocity,
        "wrench": state.wrench,
        "gripper": plant.gripper_angle,
        "zeroed": zeroed,
        "variant": variant,
        **scene.state_of(plant),
      }
    )
    clock.sleep(due - clock.now())
