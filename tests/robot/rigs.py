"""The cycle of the control process on the simulated robot, in this process.

A clock that the test turns makes it exact, and faster than time.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
import math
from typing import Any, Self

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.blackboard import Blackboard, Phase, text
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.control import Control
from apnpql_jax.robot.core import Core
from apnpql_jax.robot.hand import Hand
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import ArmState, GripperState
from apnpql_jax.robot.simulated.devices import SimulatedArm, SimulatedGripper
from apnpql_jax.robot.simulated.plant import Plant
from apnpql_jax.robot.simulated.process import RECORDS, Scene, Simulation

CONTRACT = {
  "control_period_s": 0.15,
  "joints": {"ranges": [[-6.28, 6.28]] * 6 + [[0, 1.1]]},
}
NEUTRAL = np.array([-1.8957, -1.7712, 1.9888, -1.7884, -1.5708, -0.3249])
STILL = np.zeros(6)
NEVER = math.inf
START = 100.0
"""What a clock shows at first, s."""


@dataclasses.dataclass(frozen=True)
class TurnedClock(Clock):
  """Time that passes only in ``sleep``."""

  passed: list[float] = dataclasses.field(default_factory=lambda: [START])

  def now(self) -> float:
    return self.passed[0]

  def sleep(self, seconds: float) -> None:
    self.passed[0] += max(seconds, 0.0)


class Arm(SimulatedArm):
  """The simulated arm, whose cable may be pulled out."""

  lost_at = NEVER
  waits = staticmethod(lambda: None)
  """What happens until it is at rest."""

  def __init__(self, name: str, wait: Callable[[float], None]):
    super().__init__(name)
    self.zeros, self._wait = 0, wait

  def start(self, *, zero: bool = True) -> None:
    super().start(zero=zero)
    self.zeros += zero

  def _comes_true(self, condition: Callable[[], bool]) -> bool:
    self._wait(0.01)
    return condition()

  def stop(self) -> None:
    super().stop()
    self.waits()

  def get_observation(self) -> ArmState:
    found = super().get_observation()
    if found.time < self.lost_at:
      self._last = found
    return self._last


class Gripper(SimulatedGripper):
  """The simulated gripper, whose cable may be pulled out, as its driver shows it."""

  lost_at = NEVER
  fails = False

  def get_observation(self) -> GripperState:
    found = super().get_observation()
    if found.time >= self.lost_at and self.fails:
      raise DeviceError("gripper: /dev/ttyUSB0: it does not answer")
    if found.time < self.lost_at:
      self._last = found
    return self._last


class Rig:
  """Plant and control, in turns of 2 ms."""

  def __init__(
    self,
    board: Blackboard,
    plant_board: Blackboard,
    *,
    seed: int = 0,
    task_name: str = "push_plate",
  ):
    from apnpql_jax.tasks import make_task  # Imports JAX, as no control process may.

    task = make_task(task_name)
    self.board, self.clock = board, TurnedClock()
    self.plant_board = plant_board
    self.plant = Plant(task.scene.model, seed=seed)
    self.simulation = Simulation(plant_board, self.plant, Scene(task, seed=seed))
    self.simulation.publish(self.now)
    self.arm = Arm(plant_board.name, self.step)
    self.gripper = Gripper(plant_board.name)
    for device in (self.arm, self.gripper):
      device.connect()
    hand = Hand(self.gripper, open_rad=0.0, closed_rad=1.1)
    core = Core(Cell().limits(CONTRACT))
    self.control = Control(
      self.arm,
      hand,
      core,
      board,
      clock=self.clock,
      watchdog_s=core.limits.joint_age,
    )
    self.number, self.actions = 0, 0
    self.values: np.ndarray | None = None
    """What the policy wants, or None for a policy that is silent."""

  def order(self, phase: Phase, **fields: Any) -> Any:
    """Gives an order; returns the record "state"."""
    self.number += 1
    self.actions = 0
    self.board["order"].write({"number": self.number, "phase": phase, **fields})
    return self.state

  def go_home(self, closed: bool) -> None:
    self.order(Phase.HOME, target=NEUTRAL, close=int(closed))

  def play(self, *arm: float, close: bool) -> None:
    self.values = np.array([*(arm or STILL), float(close)])
    self.order(Phase.PLAY)

  def step(self, seconds: float) -> None:
    """Runs the plant."""
    for _ in range(round(seconds / TIMESTEP)):
      self.clock.sleep(TIMESTEP)
      self.simulation.obey(self.now)
      self.simulation.step()
    self.simulation.publish(self.now)

  def turn(self, seconds: float = TIMESTEP) -> None:
    """Runs the plant, then a cycle."""
    self.step(seconds)
    if self.values is not None and self.control.phase is Phase.PLAY:
      self.actions += 1
      self.board["action"].write(
        {
          "order": self.number,
          "number": self.actions,
          "time": self.now,
          "values": self.values,
          "frames": np.full(2, self.now),
        }
      )
    self.control.cycle()

  def run(self, seconds: float) -> None:
    for _ in range(round(seconds / TIMESTEP)):
      self.turn()

  def run_until_done(self, seconds: float = 20.0) -> None:
    end = self.now + seconds
    while not (self.state["done"] and self.state["number"] == self.number):
      assert self.now < end
      self.turn()

  @property
  def now(self) -> float:
    return self.clock.now()

  @property
  def state(self) -> Any:
    return self.board["state"].read()

  @property
  def servo(self) -> Any:
    """The command to the arm: the record "servo"."""
    return self.plant_board["servo"].read()

  @property
  def reason(self) -> str:
    return text(self.state["reason"])

  @property
  def finger(self) -> float:
    return self.plant.gripper_angle

  @property
  def speed(self) -> float:
    return float(np.abs(self.plant.arm_state(0.0).velocity).max())

  @classmethod
  @contextlib.contextmanager
  def opened(cls, **options: Any) -> Generator[Self]:
    """Yields a rig with boards of its own."""
    with Blackboard() as board, Blackboard(records=RECORDS) as plant_board:
      made = cls(board, plant_board, **options)
      yield made
      made.arm.disconnect()
      made.gripper.disconnect()
