"""The cycle of the control process on the simulated robot, in this process."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from rigs import NEUTRAL, Rig

from apnpql_jax.robot.blackboard import PERIOD_BIN_S, Phase
from apnpql_jax.robot.control import GRIP_S
from apnpql_jax.robot.hand import THERE_RAD
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.supervisor import Mode
from apnpql_jax.sim import motors


@pytest.fixture
def rig() -> Iterator[Rig]:
  with Rig.opened() as made:
    yield made


@pytest.mark.parametrize("closed", [True, False])
def test_home_is_done_when_arm_and_gripper_are_there(rig, closed):
  rig.go_home(closed)
  rig.run_until_done()
  assert rig.state["mode"] == Mode.FOLLOW and rig.reason == ""
  assert np.abs(rig.state["position"] - NEUTRAL).max() < 0.01
  assert abs(rig.finger - (1.1 if closed else 0.0)) < THERE_RAD


def test_home_waits_for_a_gripper_that_is_slower_than_the_arm(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.go_home(closed=False)
  begin = rig.now
  rig.run(0.2)
  assert not rig.state["done"] and rig.finger > THERE_RAD
  rig.run_until_done()
  assert rig.finger < THERE_RAD and rig.now - begin > 0.5


def test_home_moves_no_finger_of_an_arm_that_must_not_move(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  before = rig.finger
  rig.plant.put_arm(NEUTRAL + [0, -1.0, -1.0, 0, 0, 0])  # High above the workspace.
  rig.turn()
  rig.go_home(closed=False)
  rig.run_until_done()
  assert "outside the workspace box" in rig.reason
  rig.run(0.5)
  assert rig.finger == pytest.approx(before, abs=0.01)


def test_home_ends_with_a_gripper_that_does_not_get_there(rig, monkeypatch):
  rig.go_home(closed=True)
  rig.run_until_done()
  monkeypatch.setattr(motors, "gripper_torque", lambda *_, **__: 0.0)  # No power.
  rig.go_home(closed=False)
  begin = rig.now
  rig.run_until_done()
  assert rig.reason == f"gripper: still at {rig.finger:.2f} rad after 3 s"
  assert GRIP_S < rig.now - begin < GRIP_S + 0.5


def test_home_gives_a_gripper_that_was_stuck_its_time_again(rig, monkeypatch):
  rig.go_home(closed=False)
  rig.run_until_done()
  with monkeypatch.context() as patch:
    patch.setattr(motors, "gripper_torque", lambda *_, **__: 0.0)  # No power.
    rig.go_home(closed=True)
    rig.run_until_done()
    assert rig.reason.startswith("gripper: still at ")
  rig.go_home(closed=True)
  rig.run_until_done()
  assert rig.reason == "" and abs(rig.finger - 1.1) < THERE_RAD


@pytest.mark.parametrize(("fails", "at_most"), [(False, 0.31), (True, 0.01)])
def test_a_silent_gripper_stops_an_episode_in_time(rig, fails, at_most):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(1.0, 0, 0, 0, 0, 0, close=True)
  rig.run(0.5)
  assert rig.state["mode"] == Mode.FOLLOW and rig.speed > 0.3
  rig.gripper.fails, rig.gripper.lost_at = fails, rig.now
  begin = rig.now
  while rig.state["mode"] == Mode.FOLLOW:
    rig.turn()
    assert rig.now - begin < at_most
  expected = "/dev/ttyUSB0: it does not answer" if fails else "measurement is 30"
  assert rig.reason.startswith(f"gripper: {expected}")
  rig.run(0.5)
  assert rig.state["done"] and rig.speed < 0.01


def test_an_arm_whose_connection_drops_stops(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(1.0, 0, 0, 0, 0, 0, close=True)
  rig.run(0.5)
  rig.arm.lost_at = rig.now
  rig.run(0.03)
  assert rig.state["mode"] == Mode.STOP
  assert rig.reason.startswith("joints: measurement is 2")
  rig.run(0.5)
  assert rig.state["done"] and rig.speed < 0.01
  assert not rig.control.at_rest  # Nobody can see it.


def stopped_while(rig: Rig, close: bool, after: float) -> tuple[float, float]:
  """Stops an episode some time after a command to the gripper.

  Returns the finger's angles at the stop and a second later.
  """
  rig.go_home(closed=not close)
  rig.run_until_done()
  rig.play(close=close)
  rig.run(after)
  rig.control.end_motion("test")
  rig.turn()
  assert rig.state["mode"] == Mode.STOP
  before = rig.finger
  rig.run(1.0)
  return before, rig.finger


@pytest.mark.parametrize("close", [True, False])
def test_fingers_that_move_stop_where_they_are(rig, close):
  before, after = stopped_while(rig, close, after=0.4)
  assert 0.1 < before < 1.0
  assert after == pytest.approx(before, abs=0.02)


def test_the_end_of_control_stops_the_fingers_before_it_waits_for_the_arm(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(1.0, 0, 0, 0, 0, 0, close=False)
  rig.run(0.4)
  before = rig.finger
  rig.arm.waits = lambda: rig.step(0.3)
  rig.control.close()
  assert 0.1 < before < 1.0
  assert rig.finger == pytest.approx(before, abs=0.02)


def test_a_grip_stays_after_a_stop(rig):
  """Closed fingers press on each other with all of their limited torque."""
  stopped_while(rig, True, after=3.0)
  torque = rig.plant.data.ctrl[6]
  assert torque == pytest.approx(motors.GRIPPER_TORQUE, rel=0.1)
  rig.go_home(closed=False)  # The next command is obeyed.
  rig.run_until_done()
  assert rig.finger < THERE_RAD


def test_fingers_that_have_not_begun_to_move_are_no_grip(rig, monkeypatch):
  rig.go_home(closed=False)
  rig.run_until_done()
  torque = motors.gripper_torque

  def opening(angle, velocity, *_, **__):
    return torque(angle, velocity, 0.0, np)

  with monkeypatch.context() as patch:
    patch.setattr(motors, "gripper_torque", opening)  # The command is on its way.
    rig.play(close=True)
    rig.run(0.4)
    before = rig.finger
    rig.control.end_motion("test")
    rig.turn()
  rig.run(0.5)
  assert before < THERE_RAD
  assert rig.finger == pytest.approx(before, abs=0.02)


def test_no_finger_of_the_simulated_robot_moves_before_a_command(rig):
  before = rig.finger
  rig.run(0.5)
  assert rig.finger == pytest.approx(before, abs=0.01)


def test_the_fingers_move_again_after_they_were_stopped(rig):
  stopped_while(rig, True, after=0.4)
  rig.go_home(closed=True)
  rig.run_until_done()
  assert abs(rig.finger - 1.1) < THERE_RAD


def test_rest_is_what_the_joints_show(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(1.0, 0, 0, 0, 0, 0, close=True)
  rig.run(0.5)
  assert not rig.state["at_rest"]
  rig.order(Phase.QUIT)
  while rig.control.phase is not Phase.QUIT:
    rig.turn()
    assert not rig.state["at_rest"] or rig.control.phase is Phase.IDLE
  rig.run(0.3)
  assert rig.state["at_rest"] and rig.speed < 0.01


def test_late_cycles_are_counted_but_not_waits_for_the_arm(rig):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(close=True)
  before = late(rig)
  rig.run(0.1)
  assert late(rig) == before
  rig.turn(0.006)
  rig.turn(0.002)
  rig.turn(0.008)
  assert late(rig) == before + 2


@pytest.mark.parametrize("seconds", [0.03, 0.1])
def test_an_arm_that_got_no_commands_stays_where_it_has_come_to_rest(rig, seconds):
  rig.go_home(closed=True)
  rig.run_until_done()
  rig.play(1.0, 0, 0, 0, 0, 0, close=True)
  rig.run(0.8)
  assert rig.state["mode"] == Mode.FOLLOW and rig.speed > 0.5
  command = rig.state["command"]
  rig.turn(seconds)
  assert rig.state["mode"] == Mode.STOP
  assert rig.reason == f"control: {1e3 * seconds:.0f} ms without a cycle"
  np.testing.assert_array_equal(rig.state["command"], command)
  rig.run(0.3)
  assert rig.state["done"] and rig.speed < 0.01
  np.testing.assert_allclose(rig.state["position"], command, atol=0.01)


def late(rig: Rig) -> int:
  return int(rig.state["periods"][round(2 * TIMESTEP / PERIOD_BIN_S) :].sum())
