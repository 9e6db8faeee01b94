"""The grippers RH-P12-RN and RH-P12-RN(A), by Dynamixel protocol 2.0 or Modbus-RTU.

The bus is slow (see ``buses``), so a thread reads the finger's angle and writes
commands. While the fingers move, it adapts their velocity to their angle, so that the
gap changes at the constant speed of the training. ``connect`` only reads. Mode, current
and torque go out with the first command.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.drivers import buses
from apnpql_jax.robot.drivers.rh_p12_rn import (
  CLOSED,
  ERRORS,
  OPEN,
  POSITION_MODE,
  TABLES,
  TICK,
  Field,
  Table,
  torque,
)
from apnpql_jax.robot.protocols import GripperState
from apnpql_jax.sim.motors import GRIPPER_TORQUE

BAUD = 57600  # the factory setting
CURRENT_SHARE = GRIPPER_TORQUE / torque(1.0)
"""Share of the largest current whose torque is about that of the training."""

_PERIOD = 0.005  # s between two readings at least
_ERROR_PERIOD = 0.5  # s between two readings of the hardware error status


class RHP12RN:
  """A ``Gripper`` on a serial port."""

  def __init__(
    self,
    port: str,
    *,
    baud: int = BAUD,
    device_id: int = 1,
    current_share: float = CURRENT_SHARE,
  ):
    """Stores the settings; ``connect`` opens the port.

    Args:
      port: Serial port, such as /dev/ttyUSB0.
      baud: Bits per second, as set in the gripper.
      device_id: ID on the bus, as set in the gripper.
      current_share: Limit of the current, and so of the force, in (0, 1].
    """
    self._where, self._baud, self._id = port, baud, device_id
    self._share = current_share
    self._bus: buses.Bus | None = None
    self._table: Table | None = None
    self._fastest = 0
    self._about: dict[str, Any] = {}
    self._thread: threading.Thread | None = None
    self._ending = threading.Event()
    self._state: GripperState | None = None
    self._error = ""
    self._goal: int | None = None

  def connect(self) -> None:
    """See ``protocols.Device``; identifies the model, and writes nothing.

    Harmless if it is connected.

    Raises:
      DeviceError: The port cannot be opened, nothing answers, another device does, or
        the gripper reports an error.
    """
    if self._thread:
      return
    self._goal, self._error = None, ""
    try:
      self._bus, self._table = self._identify()
      self._fastest = self._read(self._table.velocity_limit)
      self._about = self._describe(self._table)
      self._check_hardware()
      self._state = self._read_state()
    except DeviceError as error:
      self._close()
      raise DeviceError(f"gripper: {error}") from None
    self._ending.clear()
    self._thread = threading.Thread(target=self._serve, daemon=True)
    self._thread.start()

  def disconnect(self) -> None:
    """See ``protocols.Device``; the fingers hold what they hold."""
    self._ending.set()
    if self._thread:
      self._thread.join(2.0)
      self._thread = None
    self._close()

  def describe(self) -> dict[str, Any]:
    """See ``protocols.Device``; the gripper has no serial number to read."""
    return dict(self._about)

  def get_observation(self) -> GripperState:
    """See ``protocols.Gripper``.

    Raises:
      DeviceError: The gripper has fallen silent, or reports an error.
    """
    self._check()
    assert self._state
    return self._state

  def send_action(self, close: bool) -> None:
    """See ``protocols.Gripper``.

    Raises:
      DeviceError: The gripper has fallen silent, or reports an error.
    """
    self._check()
    self._goal = CLOSED if close else OPEN

  def hold(self) -> None:
    """See ``protocols.Gripper``; nothing moves before the first command.

    Raises:
      DeviceError: The gripper has fallen silent, or reports an error.
    """
    self._check()
    if self._goal is not None and self._state:
      self._goal = _goal_at(self._state.angle)

  def _check(self) -> None:
    if self._error:
      raise DeviceError(self._error)
    if self._thread is None:
      raise DeviceError(f"gripper: {self._where} is not connected")

  def _identify(self) -> tuple[buses.Bus, Table]:
    """Returns the bus on which a gripper answers, and its control table."""
    for kind in (buses.Dynamixel, buses.Modbus):
      bus = kind(self._where, self._baud, self._id)
      try:
        return bus, self._table_of(bus)
      except buses.Silent:
        bus.close()
      except DeviceError:
        bus.close()
        raise
    raise DeviceError(
      f"nothing answers at {self._where}, ID {self._id}, {self._baud} baud, neither by "
      "Dynamixel 2.0 nor by Modbus-RTU: check power, cable, ID and baud rate"
    )

  def _table_of(self, bus: buses.Bus) -> Table:
    number = int.from_bytes(bus.read(0, 2), "little")
    if number not in TABLES:
      names = " or ".join(f"{x.name} ({x.model_number})" for x in TABLES.values())
      raise DeviceError(
        f"the device at {self._where} has model number {number}, not {names}"
      )
    return TABLES[number]

  def _close(self) -> None:
    bus, self._bus = self._bus, None
    if bus:
      bus.close()

  def _describe(self, table: Table) -> dict[str, Any]:
    return {
      "model": table.name,
      "model_number": table.model_number,
      "firmware": self._read(table.firmware),
      "bus": self._open_bus().name,
      "id": self._id,
      "current_ma": self._current(table) * table.milliamperes,
    }

  def _current(self, table: Table) -> int:
    """Returns the current to set, in the gripper's unit."""
    return min(table.current(self._share), self._read(table.current_limit))

  def _prepare(self) -> None:
    """Sets mode, current, acceleration and torque; the fingers stay where they are."""
    assert (table := self._table)
    if self._read(table.operating_mode) != POSITION_MODE:
      self._write(table.torque_enable, 0)
      self._write(table.operating_mode, POSITION_MODE)
    # A profile with acceleration is the only one whose velocity can change on the way.
    self._write(table.acceleration, self._read(table.acceleration_limit))
    self._write(table.goal_current, self._current(table))
    self._state = self._read_state()  # The last one is old by now.
    here = _goal_at(self._state.angle)
    self._command(here, self._velocity(0.0))
    self._write(table.torque_enable, 1)

  def _serve(self) -> None:
    """Reads and commands until the end; an error stays until the next ``connect``."""
    asked = 0.0
    done: tuple[int, int] | None = None
    ending = False
    while not ending:
      ending = self._ending.wait(_PERIOD)  # A last pass sends what came before the end.
      try:
        state = self._read_state()
        self._state = state
        if state.time - asked > _ERROR_PERIOD:
          asked = state.time
          self._check_hardware()
        if (goal := self._goal) is not None:
          if done is None:
            self._prepare()
          wanted = goal, self._velocity(state.angle)
          if wanted != done:
            self._command(*wanted)
            done = wanted
      except Exception as error:  # That of pyserial when the adapter is pulled out.
        self._error = f"gripper: {one_line(error)}"
        return

  def _velocity(self, angle: float) -> int:
    """Returns the velocity of the profile at an angle, in the gripper's unit."""
    assert self._table
    return min(self._table.speed(angle), self._fastest)

  def _command(self, goal: int, velocity: int) -> None:
    """Writes goal and velocity, which lie next to each other, in one packet."""
    assert self._table
    pair = {self._table.goal_position: goal, self._table.velocity: velocity}
    fields = sorted(pair, key=lambda field: field.address)
    data = b"".join(pair[x].to_bytes(x.size, "little") for x in fields)
    self._open_bus().write(fields[0].address, data)

  def _read_state(self) -> GripperState:
    before = time.monotonic()
    ticks = self._ticks()
    return GripperState(0.5 * (before + time.monotonic()), ticks * TICK)

  def _ticks(self) -> int:
    """Returns the measured position, which may lie a little beyond the range."""
    assert self._table
    ticks = self._read(self._table.present_position)
    return ticks - ((ticks >> 31) << 32)  # Signed.

  def _check_hardware(self) -> None:
    assert self._table
    bits = self._read(self._table.hardware_error)
    if reasons := [text for bit, text in ERRORS.items() if bits & bit]:
      raise DeviceError(
        f"{self._where}: it stopped: {' and '.join(reasons)}; turn it off and on"
      )

  def _read(self, field: Field) -> int:
    return int.from_bytes(self._open_bus().read(field.address, field.size), "little")

  def _write(self, field: Field, value: int) -> None:
    self._open_bus().write(field.address, value.to_bytes(field.size, "little"))

  def _open_bus(self) -> buses.Bus:
    assert self._bus
    return self._bus


def _goal_at(angle: float) -> int:
  """Returns the goal at an angle, rad; the gripper refuses one beyond its range."""
  return min(max(round(angle / TICK), OPEN), CLOSED)
