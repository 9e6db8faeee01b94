"""The force sensor is not zeroed while something presses on the hand."""

from __future__ import annotations

from collections.abc import Generator

import mujoco
import numpy as np
import pytest

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.robot.board import Board, Phase
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.control import Control
from apnpql_jax.robot.core import Core
from apnpql_jax.robot.hand import Hand
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.plant import Plant
from apnpql_jax.robot.protocols import ArmState, GripperState
from apnpql_jax.robot.sensor import load
from apnpql_jax.robot.supervisor import Mode

NEUTRAL = np.array([-1.8957, -1.7712, 1.9888, -1.7884, -1.5708, -0.3249])
CONTRACT = {"control_period_s": 0.15, "joints": {"ranges": [[-6.28, 6.28]] * 7}}
AWAY = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
PRESS = np.array([0.0, 0.0, 20.0])  # N, upwards


class Device:
  """The arm or the gripper of a plant in this process."""

  time = 100.0

  def __init__(self, plant: Plant):
    self.plant, self.target, self.zeros = plant, None, 0

  def connect(self) -> None: ...

  def disconnect(self) -> None: ...

  def describe(self) -> dict:
    return {}


class PlantArm(Device):
  """An arm that moves by a cycle with each measurement."""

  def get_observation(self) -> ArmState:
    Device.time += TIMESTEP
    self.plant.step(self.target, True)
    return self.plant.arm_state(self.time)

  def send_action(self, position: np.ndarray) -> None:
    self.target = position

  def start(self, *, zero: bool = True) -> None:
    if zero:
      self.zeros += 1
      self.plant.zero_force()

  def stop(self) -> None:
    self.target = None


class PlantGripper(Device):
  """Its fingers stay closed."""

  def get_observation(self) -> GripperState:
    return GripperState(self.time, self.plant.gripper_angle)

  def send_action(self, close: bool) -> None: ...

  def hold(self) -> None: ...


class Rig:
  """The controller of the runtime in lockstep with a plant."""

  def __init__(self, board: Board, seed: int):
    model = mujoco.MjModel.from_xml_path(str(mjcf_path("push_plate")))
    self.plant, self.board = Plant(model, seed=seed), board
    self.plant.put_arm(NEUTRAL + AWAY)
    self.hand = model.body("gripper").id
    self.arm = PlantArm(self.plant)
    core = Core(Cell().limits(CONTRACT))
    hand = Hand(PlantGripper(self.plant), open_rad=0.0, closed_rad=1.1)
    self.control = Control(self.arm, hand, core, board, clock=Turned())
    self.number = 0

  def press(self, force: np.ndarray | float) -> None:
    """Presses on the hand with N in the world."""
    self.plant.data.xfrc_applied[self.hand, :3] = force
    self.idle()

  def idle(self, seconds: float = 0.2) -> None:
    for _ in range(round(seconds / TIMESTEP)):
      self.control.cycle()

  def order(self, phase: Phase, *, seconds: float = 3.0):
    """Gives an order, and returns the state when it is done, or after some time."""
    self.number += 1
    self.board["order"].write(
      {"number": self.number, "phase": phase, "target": NEUTRAL, "close": 1}
    )
    for _ in range(round(seconds / TIMESTEP)):
      self.control.cycle()
      state = self.board["state"].read()
      if state["done"]:
        break
    return state


class Turned(Clock):
  """Stands still between two cycles."""

  def now(self) -> float:
    return Device.time


@pytest.fixture(params=range(3))
def rig(request) -> Generator[Rig]:
  with Board() as board:
    found = Rig(board, request.param)
    yield found
    found.control.close()


def is_refused(state) -> bool:
  reason = state["reason"].decode()
  return (
    state["mode"] == Mode.STOP and "at rest before zeroing: free the hand" in reason
  )


def test_a_plant_takes_what_presses_on_it_for_nothing(rig):
  """As a real sensor does."""
  rig.press(0.0)
  assert load(rig.plant.arm_state(0.0).wrench) > 1  # Not zeroed yet.
  rig.press(10 * PRESS)
  rig.plant.zero_force()
  assert load(rig.plant.arm_state(0.0).wrench) < 1.1
  rig.press(0.0)
  assert rig.plant.arm_state(0.0).wrench[2] < -190


def test_a_free_hand_is_zeroed_before_each_episode(rig):
  for zeros in (2, 3):  # The first one before the first motion.
    assert rig.order(Phase.HOME)["done"]
    assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD
    assert rig.arm.zeros == zeros
    assert rig.order(Phase.IDLE)["done"]


def test_the_check_forgets_readings_from_before_the_first_zero(rig):
  """An arm in the neutral pose is there within a few cycles."""
  rig.plant.put_arm(NEUTRAL)
  rig.idle()
  assert load(rig.plant.arm_state(0.0).wrench) > 1  # Not zeroed yet.
  begin = Device.time
  assert rig.order(Phase.HOME)["done"]
  assert Device.time - begin < 0.05
  assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD


def test_a_hand_that_something_presses_on_is_not_zeroed_and_does_not_move(rig):
  rig.order(Phase.HOME)
  rig.press(PRESS)
  zeros, before = rig.arm.zeros, rig.plant.arm_state(0.0).position
  assert is_refused(rig.order(Phase.PLAY))
  rig.idle()
  assert rig.arm.zeros == zeros and rig.arm.target is None
  np.testing.assert_allclose(rig.plant.arm_state(0.0).position, before, atol=1e-3)
  rig.press(0.0)
  assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD


def test_a_force_at_the_first_zero_is_found_in_the_neutral_pose(rig):
  rig.press(PRESS)
  assert rig.order(Phase.HOME, seconds=0.01)["mode"] == Mode.FOLLOW
  rig.press(0.0)
  rig.idle(3.0)
  assert is_refused(rig.order(Phase.PLAY))


def test_the_way_home_keeps_the_zero_of_the_episode(rig):
  rig.order(Phase.HOME)
  rig.order(Phase.PLAY, seconds=0.1)
  rig.order(Phase.IDLE)
  rig.press(2 * PRESS)
  state = rig.order(Phase.HOME)
  assert state["mode"] == Mode.STOP and b"N on the tool" in state["reason"]
