"""The driver of the gripper, by the vendor's SDK, against a double on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import functools
import math
import os
from pathlib import Path
import sys
import threading
import time
import tty

import mujoco
import numpy as np
import pytest

from apnpql_jax.config import files
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import doubles
from apnpql_jax.robot.doubles.dynamixel import FIRMWARE, Gripper, crc
from apnpql_jax.robot.doubles.modbus import answer as modbus_answer, crc as modbus_crc
from apnpql_jax.robot.doubles.plant import World
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers import buses, gripper as driver
from apnpql_jax.robot.drivers.rh_p12_rn import (
  CLOSED,
  OPEN,
  TABLES,
  TICK,
  Field,
  finger_speed,
  pad_gap,
)
from apnpql_jax.robot.limits import Limits

sdk = pytest.importorskip("dynamixel_sdk", reason="needs dynamixel-sdk")

MODELS = {35073: "RH-P12-RN", 35074: "RH-P12-RN(A)"}
BUSES = [(35073, "Dynamixel 2.0"), (35074, "Dynamixel 2.0"), (35074, "Modbus-RTU")]
ADDRESSES = {35073: (562, 596, 611), 35074: (512, 564, 580)}
"""Torque enable, goal position and present position in the e-Manual."""

ATTEMPTS = buses.ATTEMPTS
"""What the driver is shipped with; see ``patience``."""

ANSWER_S = 0.022
"""Time that an answer takes, see ``buses``."""


@contextlib.contextmanager
def bench(**settings) -> Generator[tuple[str, str]]:
  """Yields the address of the doubles, and the gripper's serial port."""
  server = doubles.serve("push_plate", **settings)
  yield server.greeting
  server.close()


def connect(port: str) -> driver.RHP12RN:
  gripper = driver.RHP12RN(port)
  gripper.connect()
  return gripper


@contextlib.contextmanager
def held(port: str) -> Generator[driver.RHP12RN]:
  """Yields the connected gripper."""
  gripper = connect(port)
  yield gripper
  gripper.disconnect()


PATIENCE_S = 30.0
"""Time to wait for a motion of two seconds; on a busy machine the double is slow."""


def settle(gripper: driver.RHP12RN, angle: float) -> list:
  """Waits until the finger is at an angle; returns (time, angle) on the way."""
  end, log = time.monotonic() + PATIENCE_S, []
  while not log or abs(log[-1][1] - angle) > 0.01:
    assert time.monotonic() < end, f"at {log[-1][1]} rad"
    state = gripper.get_observation()
    log.append((state.time, state.angle))
    time.sleep(0.01)
  return log


def still(host: str) -> float:
  """Waits until the finger has not moved for 0.5 s of the double's time."""
  last = first = ask(host, "state")
  while last["time"] < first["time"] + 0.5:
    last = ask(host, "state")
    if abs(last["finger"] - first["finger"]) > 0.01:
      first = last
  return last["finger"]


def registers(port: str, number: int, bus: str) -> bytes:
  """Returns the control table, without the measured position."""
  kind = buses.Modbus if bus == "Modbus-RTU" else buses.Dynamixel
  line = kind(port, driver.BAUD, 1)
  table = bytearray(b"".join(line.read(start, 200) for start in range(0, 1000, 200)))
  line.close()
  present = TABLES[number].present_position
  table[present.address : present.address + present.size] = bytes(present.size)
  return bytes(table)


@pytest.mark.parametrize(("number", "bus"), BUSES)
def test_only_commands_change_the_gripper(number, bus):
  if modbus := bus == "Modbus-RTU":
    pytest.importorskip("pymodbus", reason="needs pymodbus")
  with bench(gripper=number, modbus=modbus) as (_, port):
    before = registers(port, number, bus)
    with held(port) as gripper:
      gripper.get_observation()
      time.sleep(0.2)
    assert registers(port, number, bus) == before
    torque = ADDRESSES[number][0]
    assert before[torque] == 0
    with held(port) as gripper:
      gripper.send_action(False)
      settle(gripper, 0.0)
    after = registers(port, number, bus)
  assert after[torque] == 1
  table = TABLES[number]

  def value(field: Field) -> int:
    return int.from_bytes(after[field.address : field.address + field.size], "little")

  share = value(table.goal_current) / table.largest_current
  assert share == pytest.approx(driver.CURRENT_SHARE, abs=1e-3)
  assert value(table.acceleration) == value(table.acceleration_limit) > 0
  assert value(table.operating_mode) == 5 and value(table.goal_position) == OPEN


@pytest.mark.parametrize(("number", "bus"), BUSES)
def test_the_model_is_identified_and_opens_and_closes(number, bus):
  if modbus := bus == "Modbus-RTU":
    pytest.importorskip("pymodbus", reason="needs pymodbus")
  with bench(gripper=number, modbus=modbus) as (host, port), held(port) as gripper:
    about = gripper.describe()
    found = about["model"], about["model_number"], about["bus"]
    assert found == (MODELS[number], number, bus)
    assert about["firmware"] == FIRMWARE
    for close, angle in ((False, 0.0), (True, 1.1), (False, 0.0)):
      gripper.send_action(close)
      gripper.send_action(close)  # Changes nothing.
      settle(gripper, angle)
      truth = still(host)
      assert gripper.get_observation().angle == pytest.approx(truth, abs=2 * TICK)


@pytest.mark.parametrize("close", [True, False])
def test_fingers_on_their_way_are_held(close):
  with bench() as (host, port), held(port) as gripper:
    gripper.hold()  # Nothing to hold before the first command.
    gripper.send_action(not close)
    settle(gripper, 0.0 if close else 1.1)
    gripper.send_action(close)
    end = time.monotonic() + PATIENCE_S
    while (gripper.get_observation().angle > 0.5) != close:
      assert time.monotonic() < end
      time.sleep(0.005)
    gripper.hold()
    held_at = still(host)
    assert held_at == pytest.approx(0.5, abs=0.3)
    assert still(host) == pytest.approx(held_at, abs=0.01)
    gripper.send_action(close)
    settle(gripper, 1.1 if close else 0.0)


def test_a_hold_at_the_end_still_holds(monkeypatch):
  """As when the control process ends: the driver is closed at once."""
  monkeypatch.setattr(driver, "_PERIOD", 0.1)  # It comes between two readings.
  with bench() as (host, port), held(port) as gripper:
    gripper.send_action(True)
    settle(gripper, 1.1)
    gripper.send_action(False)
    end = time.monotonic() + PATIENCE_S
    while gripper.get_observation().angle > 0.9:
      assert time.monotonic() < end
      time.sleep(0.005)
    gripper.hold()
    gripper.disconnect()
    time.sleep(1.0)
    assert ask(host, "state")["finger"] > 0.6


@pytest.mark.parametrize("modbus", [False, True])
def test_a_measurement_is_not_too_old_while_the_settings_are_written(
  modbus, monkeypatch
):
  """It counts messages, because doubles answer sooner than the real line."""
  if modbus:
    pytest.importorskip("pymodbus", reason="needs pymodbus")
  kind = buses.Modbus if modbus else buses.Dynamixel
  with bench(gripper=35074, modbus=modbus) as (_, port):
    line = kind(port, driver.BAUD, 1)
    line.write(11, bytes([3]))  # Another mode than the driver's.
    line.close()
    with held(port) as gripper:
      told, send = [], kind._try

      def count(*args, **named):
        told.append(gripper.get_observation().time)
        return send(*args, **named)

      monkeypatch.setattr(kind, "_try", count)
      gripper.send_action(False)
      settle(gripper, 0.0)
  messages = max(told.count(time) for time in set(told))
  age = driver._PERIOD + (messages + 0.5) * ANSWER_S
  assert messages > 5 and age < Limits.gripper_age


def test_the_gap_closes_at_the_speed_of_the_training():
  with bench() as (host, port), held(port) as gripper:
    gripper.send_action(False)
    settle(gripper, 0.0)
    gripper.send_action(True)
    states = [ask(host, "state")]
    while states[-1]["finger"] < 1.09:
      assert states[-1]["time"] < states[0]["time"] + 6
      states.append(ask(host, "state"))
  # By its own clock, which waits for a process that is starved.
  times, angles = np.transpose([(x["time"], x["finger"]) for x in states])
  gaps = np.array([pad_gap(angle) for angle in angles])
  inner = (gaps < 0.09) & (gaps > 0.015)  # After the ramp of the profile.
  speed = -np.polyfit(times[inner], gaps[inner], 1)[0]
  assert speed == pytest.approx(0.075, rel=0.15)


@pytest.mark.parametrize("number", MODELS)
def test_the_double_has_the_table_of_the_manual(number):
  torque, goal, present = ADDRESSES[number]
  with bench(gripper=number) as (_, port):
    serial, packets = sdk.PortHandler(port), sdk.PacketHandler(2.0)
    serial.setBaudRate(57600)

    def retry(call, *args):
      for _ in range(20):
        *values, result, error = call(serial, 1, *args)
        if result == sdk.COMM_SUCCESS:
          return *values, error
      raise AssertionError("the double does not answer")

    assert retry(packets.ping)[0] == number
    closed = retry(packets.read4ByteTxRx, present)[0]
    assert closed == pytest.approx(1.1 / TICK, abs=2)
    retry(packets.write4ByteTxRx, goal, 300)
    time.sleep(0.3)
    assert retry(packets.read4ByteTxRx, present)[0] == pytest.approx(closed, abs=15)
    # Goal current and velocity.
    retry(packets.write2ByteTxRx, 604 if number == 35073 else 550, 200)
    retry(packets.write1ByteTxRx, torque, 1)
    end = time.monotonic() + PATIENCE_S
    while retry(packets.read4ByteTxRx, present)[0] != pytest.approx(300, abs=3):
      assert time.monotonic() < end
    assert retry(packets.write4ByteTxRx, goal, 1151)[0] == sdk.ERRNUM_DATA_LIMIT
    assert retry(packets.write1ByteTxRx, 11, 0)[0] == sdk.ERRNUM_ACCESS
    serial.closePort()


def test_ticks_span_the_range_of_the_joint():
  model = mujoco.MjModel.from_xml_path(str(files.mjcf_path("robot")))
  assert OPEN * TICK == model.joint("finger_r1").range[0]
  # At 740 ticks the pads would touch: the fingers squeeze in the closed position.
  assert model.joint("finger_r1").range[1] < CLOSED * TICK < 1.15
  assert pad_gap(CLOSED * TICK) < 0 < pad_gap(1.1) < 0.003


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.7, 1.1])
def test_gap_and_speed_are_those_of_the_linkage(angle):
  model = mujoco.MjModel.from_xml_path(str(files.mjcf_path("robot")))
  data = mujoco.MjData(model)

  def gap(q: float) -> float:
    for name in ("finger_r1", "finger_r2", "finger_l1", "finger_l2"):
      data.qpos[model.joint(name).qposadr[0]] = q
    mujoco.mj_kinematics(model, data)
    pads = [data.geom(name) for name in ("r_pad", "l_pad")]
    distance = np.linalg.norm(pads[0].xpos - pads[1].xpos)
    return float(distance) - 2 * model.geom("r_pad").size[1]

  assert pad_gap(angle) == pytest.approx(gap(angle), abs=2e-4)
  slope = (gap(angle + 1e-4) - gap(angle - 1e-4)) / 2e-4
  assert -slope * finger_speed(angle) == pytest.approx(0.075, rel=0.01)


@pytest.mark.parametrize("modbus", [False, True])
def test_a_silent_gripper_is_one_line_in_time(modbus, monkeypatch):
  if modbus:
    pytest.importorskip("pymodbus", reason="needs pymodbus")
  with bench(modbus=modbus) as (host, port), held(port) as gripper:
    last = gripper.get_observation().time
    monkeypatch.setattr(buses, "ATTEMPTS", ATTEMPTS)
    with pytest.raises(DeviceError, match="does not answer: check its power") as error:
      ask(host, "silence_gripper")
      begin = time.monotonic()
      while time.monotonic() < begin + 3:
        last = gripper.get_observation().time
        time.sleep(0.01)
    assert time.monotonic() < begin + 0.4  # 0.12 s on an idle machine.
    assert last < begin + 0.1  # Until then, the old measurement keeps its time.
    assert "\n" not in str(error.value)
    with pytest.raises(DeviceError, match="does not answer"):
      gripper.send_action(True)


def test_a_hardware_error_is_one_line():
  with bench() as (host, port), held(port) as gripper:
    ask(host, "fail_gripper")
    end = time.monotonic() + 3
    with pytest.raises(DeviceError, match="it is overloaded; turn it off and on"):
      while time.monotonic() < end:
        gripper.get_observation()
        time.sleep(0.01)
    with pytest.raises(DeviceError, match="it is overloaded; turn it off and on"):
      connect(port)


def test_another_dynamixel_is_one_line():
  with (
    bench(model_number=1020) as (_, port),
    pytest.raises(DeviceError, match=r"number 1020, not RH-P12-RN \(35073\) or"),
  ):
    connect(port)


@contextlib.contextmanager
def terminal(answer: Callable[[bytes], bytes]) -> Generator[tuple[str, int]]:
  """Yields a serial port behind which ``answer`` answers, and its descriptor."""
  ours, theirs = os.openpty()
  tty.setraw(theirs)

  def serve() -> None:
    with contextlib.suppress(OSError):
      while data := os.read(ours, 100):
        os.write(ours, answer(data))

  threading.Thread(target=serve, daemon=True).start()
  yield os.ttyname(theirs), ours
  os.close(theirs)


@pytest.mark.parametrize("echo", [False, True])
def test_a_port_without_a_gripper_is_one_line(echo, monkeypatch):
  monkeypatch.setattr(buses, "ATTEMPTS", ATTEMPTS)
  begin = time.monotonic()
  with (
    terminal(lambda data: data if echo else b"") as (port, _),
    pytest.raises(DeviceError, match="nothing answers at /dev/pts") as error,
  ):
    connect(port)
  assert time.monotonic() - begin < 3
  assert "\n" not in str(error.value)


def test_a_packet_that_is_damaged_on_its_way_is_sent_again():
  """The gripper answers a damaged instruction with an error and no data."""
  table, damaged = TABLES[35074], []
  double = Gripper(table, World("push_plate", noise=False))

  def answer(data: bytes) -> bytes:
    if damaged:
      data = bytes([*data[:8], data[8] ^ damaged.pop(), *data[9:]])
    return double.receive(data)

  with terminal(answer) as (port, _):
    line = buses.Dynamixel(port, driver.BAUD, 1)
    for field in (table.torque_enable, table.current_limit, table.present_position):
      damaged.append(1 << 4)
      expected = double.load(field.address, field.size)
      assert line.read(field.address, field.size) == expected
      assert not damaged
    goal = (300).to_bytes(4, "little")
    damaged.append(1 << 4)
    line.write(table.goal_position.address, goal)
    line.close()
  assert not damaged and double.load(table.goal_position.address, 4) == goal


@pytest.mark.parametrize("modbus", [False, True])
def test_a_late_answer_is_not_taken_for_that_to_the_next_request(modbus):
  """The first comes after the second request, and the second a little later."""
  if modbus:
    pytest.importorskip("pymodbus", reason="needs pymodbus")
  kind = buses.Modbus if modbus else buses.Dynamixel
  table, delays = TABLES[35074], []
  double = Gripper(table, World("push_plate", noise=False))
  receive = functools.partial(modbus_answer, double) if modbus else double.receive

  def answer(data: bytes) -> bytes:
    time.sleep(delays.pop(0) if delays else 0.0)
    return receive(data)

  with terminal(answer) as (port, _):
    line = kind(port, driver.BAUD, 1)
    delays += [0.05, 0.01]
    for field in (table.present_position, table.current_limit, table.hardware_error):
      expected = double.load(field.address, field.size)
      assert line.read(field.address, field.size) == expected
    line.close()
  assert not delays


def test_the_driver_does_not_spin_while_it_waits(monkeypatch):
  double = Gripper(TABLES[35074], World("push_plate", noise=False))
  calls, read = [], sdk.PortHandler.readPort

  def count(port, length):
    calls.append(length)
    return read(port, length)

  def answer(data: bytes) -> bytes:
    time.sleep(ANSWER_S)
    return double.receive(data)

  monkeypatch.setattr(sdk.PortHandler, "readPort", count)
  with terminal(answer) as (port, _):
    line = buses.Dynamixel(port, driver.BAUD, 1)
    begin = time.monotonic()
    line.read(TABLES[35074].present_position.address, 4)
    assert time.monotonic() - begin >= ANSWER_S
    line.close()
  assert 2 <= len(calls) < 30


def test_a_refusal_or_an_answer_without_data_is_no_measurement():
  access, nothing = 7, 0
  double = Gripper(TABLES[35074], World("push_plate", noise=False))
  errors = []
  with terminal(lambda _: double._status(errors[-1])) as (port, _):
    line = buses.Dynamixel(port, driver.BAUD, 1)
    errors.append(access)
    with pytest.raises(DeviceError, match="it refuses to read 580: .*not available"):
      line.read(580, 4)
    errors.append(nothing)
    with pytest.raises(DeviceError, match="it answers 2 bytes of 4 at 580"):
      line.read(580, 4)
    line.close()


def test_an_adapter_that_is_pulled_out_is_one_line():
  double = Gripper(TABLES[35074], World("push_plate", noise=False))
  with terminal(double.receive) as (port, descriptor):
    line = buses.Dynamixel(port, driver.BAUD, 1)
    assert line.read(0, 2) == (35074).to_bytes(2, "little")
    os.close(descriptor)
    with pytest.raises(DeviceError, match=port) as error:
      line.read(0, 2)
    with pytest.raises(DeviceError, match=port):
      line.write(564, bytes(4))
    line.close()
  assert "\n" not in str(error.value)


def test_a_refusal_by_modbus_closes_the_port():
  pytest.importorskip("pymodbus", reason="needs pymodbus")
  reply = b"\x01\x83\x02"  # Illegal data address.
  reply += modbus_crc(reply).to_bytes(2, "little")

  def refuse(data: bytes) -> bytes:
    return reply if data.startswith(b"\x01\x03") else b""  # Not of Dynamixel.

  with terminal(refuse) as (port, _):
    before = len(opened(port))
    with pytest.raises(DeviceError, match="it refuses register 0") as error:
      connect(port)
    assert len(opened(port)) == before == 1, error  # Whose frames keep the bus.


def opened(port: str) -> list[Path]:
  """Returns the descriptors of this process that are open on a port."""
  found = []
  for link in Path("/proc/self/fd").iterdir():
    with contextlib.suppress(OSError):
      found += [link] * (os.readlink(link) == port)
  return found


def test_a_missing_port_or_package_is_one_line(monkeypatch):
  with pytest.raises(DeviceError) as error:
    connect("/dev/nothing")
  message = "gripper: could not open port /dev/nothing: No such file or directory"
  assert str(error.value) == message
  monkeypatch.setitem(sys.modules, "dynamixel_sdk", None)
  with pytest.raises(DeviceError, match="robot needs dynamixel-sdk: pip install"):
    connect("/dev/nothing")


def test_the_checksums_are_those_of_the_protocols():
  rng = np.random.default_rng(0)
  for size in (1, 8, 40):
    data = rng.integers(0, 256, size).tolist()
    assert crc(bytes(data)) == sdk.PacketHandler(2.0).updateCRC(0, data, size)
  assert modbus_crc(b"123456789") == 0x4B37  # The check value of CRC-16/MODBUS.
  assert math.isclose(math.degrees(TICK), 0.088, abs_tol=2e-4)  # e-Manual: precision
