"""The driver of the arm, by the vendor's client, against a double of the controller."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.controller import SERIAL, VERSION
from apnpql_jax.robot.doubles.plant import DRIFT
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers.ur5e import WATCHDOG, UR5e
from apnpql_jax.robot.limits import TIMESTEP

pytest.importorskip("rtde_control", reason="needs ur_rtde")


@pytest.fixture
def rig() -> Generator[doubles.Doubles]:
  """Yields the arm of push_plate, started."""
  with doubles.start("push_plate", noise=False) as devices:
    devices.arm.start()
    yield devices


def servo(arm: UR5e, path: Callable[[float], np.ndarray], seconds: float) -> list:
  """Commands a path for a time; returns (time, command, state) of every cycle."""
  begin = due = time.monotonic()
  log = []
  while (now := time.monotonic()) < begin + seconds:
    command = path(now - begin)
    arm.send_action(command)
    log.append((now, command, arm.get_observation()))
    due = max(due + TIMESTEP, now)
    time.sleep(max(0.0, due - time.monotonic()))
  return log


def wait_for_fault(arm: UR5e) -> str:
  """Returns the fault of the arm, at most a second later."""
  end = time.monotonic() + 1
  while not (fault := arm.get_observation().fault):
    assert time.monotonic() < end
  return fault


def test_the_state_is_that_of_the_plant(rig):
  state = rig.arm.get_observation()
  np.testing.assert_allclose(state.position, rig.ask("state")["position"], atol=1e-6)
  np.testing.assert_allclose(state.velocity, np.zeros(6), atol=1e-4)
  assert not state.fault
  assert 0 <= time.monotonic() - state.time < 0.1


def test_the_arm_follows_its_targets(rig):
  start = rig.arm.get_observation().position
  swing = np.array([0.2, 0.1, -0.1, 0.2, -0.2, 0.3])
  path = lambda t: start + swing * np.sin(min(t, 1) * np.pi / 2) ** 2  # noqa: E731
  log = servo(rig.arm, path, 2.0)
  real = np.stack([state.position for _, _, state in log])
  np.testing.assert_allclose(real[-1], start + swing, atol=1e-3)
  along = (real - start) @ swing / (swing @ swing)  # The share of the way.
  assert (np.diff(along) > -1e-3).all() and along.max() < 1.001
  stamps = np.array([state.time for _, _, state in log])
  assert (np.diff(stamps) >= 0).all() and len(set(stamps)) > 100


def test_it_brakes_to_rest_and_starts_again(rig):
  start = rig.arm.get_observation().position
  speed = np.array([0.5, 0, 0, 0, 0, 0])
  log = servo(rig.arm, lambda t: start + speed * t, 0.6)
  assert log[-1][2].velocity[0] > 0.1
  rig.arm.stop()
  rest = rig.arm.get_observation()
  assert np.abs(rest.velocity).max() < 0.02
  with pytest.raises(DeviceError, match="only after start"):
    rig.arm.send_action(rest.position)
  rig.arm.start()
  servo(rig.arm, lambda _: start, 1.0)
  np.testing.assert_allclose(rig.ask("state")["position"], start, atol=1e-3)


@pytest.mark.parametrize("joints", [np.zeros(7), np.full(6, np.nan)])
def test_what_is_not_six_angles_is_refused(rig, joints):
  with pytest.raises(DeviceError, match="are not 6 joint angles"):
    rig.arm.send_action(joints)
  assert not rig.arm.get_observation().fault


def test_start_takes_bias_and_payload_off_the_wrench():
  with doubles.start("push_plate", noise=False) as devices:
    before = devices.arm.get_observation().wrench
    devices.arm.start()
    after = devices.arm.get_observation().wrench
  assert np.linalg.norm(before[:3]) > 2 and np.linalg.norm(after) < 1e-3


def test_start_keeps_the_zero_if_asked_to():
  with doubles.start("push_plate", noise=False) as devices:
    devices.arm.start(zero=False)
    assert np.linalg.norm(devices.arm.get_observation().wrench[:3]) > 2
    devices.arm.stop()
    devices.arm.start()
    assert np.linalg.norm(devices.arm.get_observation().wrench) < 1e-3


def test_the_zero_of_the_wrench_drifts_until_the_next_one(rig):
  rig.ask("drift_force")
  rig.arm.stop()
  np.testing.assert_allclose(rig.arm.get_observation().wrench, DRIFT, atol=1e-3)
  rig.arm.start()
  assert np.linalg.norm(rig.arm.get_observation().wrench) < 1e-3


def test_the_table_pushes_the_tool_up(rig):
  position, force = rig.arm.get_observation().position, 0.0
  for _ in range(6000):
    position = position + np.array([0, 1, 0, -1, 0, 0]) * 0.15 * TIMESTEP
    force = servo(rig.arm, lambda _: position, 0.0005)[-1][2].wrench[2]  # noqa: B023
    if force > 20:
      break
  assert force > 20
  state = rig.arm.get_observation()
  rig.arm.stop()
  # Tip and table slide with a friction of 0.8.
  assert state.wrench[2] > np.linalg.norm(state.wrench[:2]) / 0.81


@pytest.mark.parametrize(
  ("cause", "text"),
  [
    ("drop_rtde", "lost the connection"),
    ("protective_stop", "protective stop"),
    ("emergency_stop", "emergency stop"),
    ("stop_program", "program on the controller stopped"),
  ],
)
def test_each_fault_is_one_line_in_time(rig, cause, text):
  start = rig.arm.get_observation().position
  servo(rig.arm, lambda _: start, 0.05)
  rig.ask(cause)
  begin = time.monotonic()
  fault = wait_for_fault(rig.arm)
  assert time.monotonic() < begin + 0.5
  assert text in fault and "\n" not in fault
  with pytest.raises(DeviceError, match=text) as error:
    rig.arm.send_action(start)
  assert "\n" not in str(error.value)
  rig.arm.stop()  # Harmless.


CLIENT = """
import sys, time
from apnpql_jax.robot.drivers.ur5e import UR5e
arm = UR5e(sys.argv[1], payload_kg=0.5, payload_cog_m=[0, 0, 0.05])
arm.connect()
arm.start()
position = arm.get_observation().position
while True:
  position = position + [0.001, 0, 0, 0, 0, 0]
  arm.send_action(position)
  time.sleep(0.002)
"""


def test_the_watchdog_stops_the_arm_of_a_client_that_hangs():
  server = doubles.serve("push_plate", noise=False)
  host, _ = server.greeting
  begin = ask(host, "state")["position"][0]
  with subprocess.Popen([sys.executable, "-c", CLIENT, host]) as client:
    end = time.monotonic() + 30
    while ask(host, "state")["position"][0] < begin + 0.1:
      assert client.poll() is None and time.monotonic() < end
    client.send_signal(signal.SIGSTOP)
    end = time.monotonic() + 3 / WATCHDOG
    while (state := ask(host, "state"))["program_runs"]:
      assert time.monotonic() < end
    time.sleep(0.5)  # It brakes.
    rest = ask(host, "state")["position"]
    time.sleep(0.3)
    np.testing.assert_allclose(ask(host, "state")["position"], rest, atol=1e-4)
    assert rest[0] < state["position"][0] + 0.2
    client.kill()
  server.close()


def test_the_program_goes_on_at_rest_while_the_arm_is_read(rig):
  rig.arm.stop()
  end = time.monotonic() + 3 / WATCHDOG
  while time.monotonic() < end:
    rig.arm.get_observation()
    time.sleep(TIMESTEP)
  assert rig.ask("state")["program_runs"]
  time.sleep(2 / WATCHDOG)  # Nobody reads.
  assert not rig.ask("state")["program_runs"]
  rig.arm.start()
  assert rig.ask("state")["program_runs"] and rig.ask("state")["programs"] == 2


def test_a_command_that_the_double_lacks_ends_the_program(rig):
  assert not rig.arm._control.setTcp([0.0] * 6)
  assert not rig.ask("state")["program_runs"]


def test_a_lost_connection_does_not_end_the_process():
  code = """
import gc, time
from apnpql_jax.robot import doubles
with doubles.start("push_plate") as rig:
  rig.arm.start()
  rig.ask("drop_rtde")
  time.sleep(0.5)
  rig.arm.disconnect()
  rig.arm = None
  gc.collect()
print("alive")
"""
  done = subprocess.run(
    [sys.executable, "-c", code], capture_output=True, text=True, timeout=60
  )
  assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "alive")


def test_it_starts_again_after_the_program_stopped(rig):
  start = rig.arm.get_observation().position
  servo(rig.arm, lambda t: start + [0.5 * t, 0, 0, 0, 0, 0], 0.5)
  rig.ask("stop_program")
  wait_for_fault(rig.arm)
  rig.arm.stop()
  time.sleep(0.3)
  rest = np.array(rig.ask("state")["position"])
  rig.arm.start()
  time.sleep(0.3)  # A program that obeys the old target would move the arm.
  np.testing.assert_allclose(rig.ask("state")["position"], rest, atol=1e-4)
  servo(rig.arm, lambda t: rest + [0.2 * t, 0, 0, 0, 0, 0], 0.5)
  assert not rig.arm.get_observation().fault
  assert rig.arm.get_observation().position[0] > rest[0] + 0.05


def test_a_collision_is_a_protective_stop(rig):
  start = rig.arm.get_observation().position
  with pytest.raises(DeviceError, match="protective stop"):
    servo(rig.arm, lambda t: start + 0.3 * t * np.array([0, 1, 0, -1, 0, 0]), 10.0)


@pytest.mark.parametrize(
  ("controller", "text"),
  [
    ({"model": "UR10"}, "must be a UR5e, not a UR10"),
    ({"remote": False}, "switch to remote control"),
  ],
)
def test_a_controller_that_will_not_do_is_one_line(controller, text):
  with (
    pytest.raises(DeviceError, match=text) as error,
    doubles.start("push_plate", **controller),
  ):
    pass
  assert "\n" not in str(error.value)


@pytest.mark.parametrize("cause", ["protective_stop", "emergency_stop"])
def test_a_stopped_arm_gets_no_program(cause):
  server = doubles.serve("push_plate")
  host, _ = server.greeting
  ask(host, cause)
  arm = UR5e(host, payload_kg=0.5, payload_cog_m=[0, 0, 0.05])
  with pytest.raises(DeviceError, match=cause.replace("_", " ")):
    arm.connect()
  assert ask(host, "state")["programs"] == 0
  server.close()


def test_a_slowed_arm_does_not_start():
  with (
    doubles.start("push_plate", speed_slider=0.5) as devices,
    pytest.raises(DeviceError, match="the speed slider is at 50%: set it to 100%"),
  ):
    devices.arm.start()


def test_describe_names_device_and_versions(rig):
  about = rig.arm.describe()
  assert (about["model"], about["serial_number"]) == ("UR5e", SERIAL)
  assert about["polyscope"] == ".".join(map(str, VERSION))
  assert about["payload_kg"] == doubles.PAYLOAD_KG


def _silent(client: socket.socket) -> None:
  client.recv(100)
  time.sleep(20)


def _http(client: socket.socket) -> None:
  client.recv(100)
  client.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")


def _echo(client: socket.socket) -> None:
  while data := client.recv(1000):
    client.sendall(data)


@contextlib.contextmanager
def _servers(host: str, act: Callable[[socket.socket], None]) -> Generator[None]:
  """Serves something else on the ports of a controller."""
  listeners = [socket.create_server((host, p)) for p in (29999, 30003, 30004)]

  def answer(client: socket.socket) -> None:
    with contextlib.suppress(OSError), client:
      act(client)

  def serve(listener: socket.socket) -> None:
    with contextlib.suppress(OSError):
      while True:
        client, _ = listener.accept()
        threading.Thread(target=answer, args=(client,), daemon=True).start()

  for listener in listeners:
    threading.Thread(target=serve, args=(listener,), daemon=True).start()
  yield
  for listener in listeners:
    listener.close()


@pytest.mark.parametrize(("act", "count"), [(_silent, 247), (_http, 248), (_echo, 249)])
def test_another_server_is_one_line_within_seconds(act, count):
  begin, host = time.monotonic(), doubles.address(os.getpid(), count)
  arm = UR5e(host, payload_kg=0.5, payload_cog_m=[0, 0, 0.05])
  with _servers(host, act), pytest.raises(DeviceError, match="30004") as error:
    arm.connect()
  assert time.monotonic() - begin < 5
  assert "\n" not in str(error.value)


def test_a_closed_port_is_one_line():
  arm = UR5e("127.0.7.8", payload_kg=0.5, payload_cog_m=[0, 0, 0.05])
  with pytest.raises(DeviceError, match="30004: Connection refused"):
    arm.connect()
  arm.disconnect()  # Harmless.


def test_a_missing_package_is_one_line(monkeypatch):
  monkeypatch.setitem(sys.modules, "rtde_receive", None)
  arm = UR5e("127.0.7.8", payload_kg=0.5, payload_cog_m=[0, 0, 0.05])
  with pytest.raises(DeviceError, match=r"robot needs ur_rtde: pip install"):
    arm.connect()
