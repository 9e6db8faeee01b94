"""The force sensor is not zeroed while something presses on the hand."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import numpy as np
import pytest
import rigs
from rigs import NEUTRAL

from apnpql_jax.robot.blackboard import Blackboard, Phase
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.sensor import load
from apnpql_jax.robot.supervisor import Mode

AWAY = np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])
PRESS = np.array([0.0, 0.0, 20.0])  # N, upwards


class Rig(rigs.Rig):
  """A rig that begins near the neutral pose, and on which something may press."""

  def __init__(self, *boards: Blackboard, seed: int):
    super().__init__(*boards, seed=seed)
    self.plant.put_arm(NEUTRAL + AWAY)
    self.hand = self.plant.model.body("gripper").id

  def press(self, force: np.ndarray | float) -> None:
    """Presses on the hand with N in the world."""
    self.plant.data.xfrc_applied[self.hand, :3] = force
    self.idle()

  def idle(self, seconds: float = 0.2) -> None:
    self.run(seconds)

  def order(self, phase: Phase, *, seconds: float = 3.0, **fields: Any) -> Any:
    """Gives an order, and returns the state when it is done, or after some time."""
    super().order(phase, target=NEUTRAL, close=1, **fields)
    for _ in range(round(seconds / TIMESTEP)):
      self.turn()
      if self.state["done"]:
        break
    return self.state


@pytest.fixture(params=range(3))
def rig(request) -> Generator[Rig]:
  with Rig.opened(seed=request.param) as found:
    yield found
    found.control.close()


def is_refused(state) -> bool:
  reason = state["reason"].decode()
  return state["mode"] == Mode.STOP and "at rest: free the hand" in reason


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
  begin = rig.now
  assert rig.order(Phase.HOME)["done"]
  assert rig.now - begin < 0.15  # Of which the check needs 0.1.
  assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD


def test_a_hand_that_something_presses_on_is_not_zeroed_and_does_not_move(rig):
  rig.order(Phase.HOME)
  rig.press(PRESS)
  zeros, before = rig.arm.zeros, rig.plant.arm_state(0.0).position
  assert is_refused(rig.order(Phase.PLAY))
  rig.idle()
  assert rig.arm.zeros == zeros and not rig.servo["follow"]
  np.testing.assert_allclose(rig.plant.arm_state(0.0).position, before, atol=1e-3)
  rig.press(0.0)
  assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD


def test_a_force_at_the_first_zero_is_found_in_the_neutral_pose(rig):
  rig.press(PRESS)
  assert rig.order(Phase.HOME, seconds=0.01)["mode"] == Mode.FOLLOW
  rig.press(0.0)
  rig.run_until_done()
  assert is_refused(rig.state)


def test_the_way_home_keeps_the_zero_of_the_episode(rig):
  rig.order(Phase.HOME)
  rig.order(Phase.PLAY, seconds=0.1)
  rig.order(Phase.IDLE)
  rig.press(2 * PRESS)
  state = rig.order(Phase.HOME)
  assert state["mode"] == Mode.STOP and b"N on the tool" in state["reason"]


def offset(rig: Rig) -> np.ndarray:
  """Returns the reading of an unloaded sensor, without its noise."""
  return np.mean([rig.plant.sensor.read(np.zeros(6)) for _ in range(5000)], axis=0)


def test_each_way_home_shows_the_error_of_the_zero(rig):
  """That of the last zero and what came since; the next episode takes it away."""
  for drift in (0.0, 1.0):
    rig.plant.sensor.drift(np.array([0, 0, drift, 0, 0, 0]))
    error = offset(rig)
    rig.order(Phase.HOME)
    if drift:
      np.testing.assert_allclose(rig.state["unloaded"], error, atol=0.35)
    assert np.isfinite(rig.state["unloaded"]).all() and rig.state["mode"] == Mode.FOLLOW
    assert rig.order(Phase.PLAY, seconds=0.1)["mode"] == Mode.HOLD
    assert np.linalg.norm(offset(rig) - error) > 0.5  # A new error, drawn at the zero.
    assert np.isnan(rig.state["unloaded"]).all()
    rig.order(Phase.IDLE)


def test_a_zero_that_becomes_wrong_in_an_episode_is_found_after_it(rig):
  rig.order(Phase.HOME)
  rig.order(Phase.PLAY, seconds=0.1)
  rig.plant.sensor.drift(np.array([0, 0, 15.0, 0, 0, 0]))
  error, zeros = offset(rig), rig.arm.zeros
  rig.idle(0.2)  # A contact would read the same, so the episode continues.
  assert rig.state["mode"] == Mode.HOLD and rig.reason.startswith("policy: ")
  rig.order(Phase.IDLE)
  assert is_refused(rig.order(Phase.HOME))
  np.testing.assert_allclose(rig.state["unloaded"], error, atol=0.35)
  assert rig.arm.zeros == zeros
  assert is_refused(rig.order(Phase.PLAY))
