"""A gripper that speaks Dynamixel protocol 2.0 on a pseudo-terminal.

It follows the protocol's page in the manufacturer's e-Manual. Registers that the driver
does not use hold zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
import os
import tty

from apnpql_jax.robot.doubles.plant import World
from apnpql_jax.robot.drivers.rh_p12_rn import TICK, Field, Table, torque
from apnpql_jax.robot.limits import TIMESTEP

FIRMWARE = 11
DEVICE_ID = 1
_HEADER = b"\xff\xff\xfd\x00"
_PING, _READ, _WRITE, _STATUS = 1, 2, 3, 0x55
_CRC_ERROR, _LIMIT_ERROR, _ACCESS_ERROR, _INSTRUCTION_ERROR = 3, 6, 7, 2
_ALERT = 0x80
_REVOLUTION = 2 * math.pi / 60
_DEFAULTS = {  # EEPROM as delivered: e-Manual
  "RH-P12-RN": {"current_limit": 820, "velocity_limit": 100, "acceleration_limit": 255},
  "RH-P12-RN(A)": {
    "current_limit": 1984,
    "velocity_limit": 2970,
    "acceleration_limit": 3447,
  },
}
_ACCELERATION = {"RH-P12-RN": 214.577, "RH-P12-RN(A)": 1.0}  # rev/min^2 per unit


class Gripper:
  """Registers, and what they make the plant's fingers do."""

  def __init__(self, table: Table, plant: World, model_number: int | None = None):
    """Starts with the torque off; another model number is for tests."""
    self.table, self._plant = table, plant
    self._memory = bytearray(1024)
    self._buffer = b""
    self.silent = False
    self._speed = 0.0
    self._set(Field(0, 2), model_number or table.model_number)
    self._set(Field(7, 1), DEVICE_ID)
    self._set(table.firmware, FIRMWARE)
    self._set(table.operating_mode, 5)
    for name, value in _DEFAULTS[table.name].items():
      self._set(getattr(table, name), value)
    self.cycle()

  def fail(self, bits: int) -> None:
    """Reports a hardware error and turns the torque off."""
    self._set(self.table.hardware_error, bits)
    self._set(self.table.torque_enable, 0)

  def cycle(self) -> None:
    """Moves the fingers along the profile of position and velocity."""
    table, plant = self.table, self._plant
    self._set(table.present_position, round(plant.finger / TICK) & 0xFFFFFFFF)
    if not self._get(table.torque_enable):
      plant.grip(plant.finger, 0.0, 0.0)
      return
    goal = self._get(table.goal_position) * TICK
    limit = self._get(table.velocity) or self._get(table.velocity_limit)
    rate = self._get(table.acceleration) * _ACCELERATION[table.name] * _REVOLUTION / 60
    limit = limit * table.rpm * _REVOLUTION
    faster = self._speed + rate * TIMESTEP if rate else limit
    self._speed = min(limit, faster) if abs(goal - plant.finger) > TICK else 0.0
    share = self._get(table.goal_current) / table.largest_current
    plant.grip(goal, self._speed, torque(share))

  def load(self, address: int, size: int) -> bytes:
    """Returns registers."""
    return bytes(self._memory[address : address + size])

  def store(self, address: int, data: bytes) -> int:
    """Writes registers; returns the error of the status packet."""
    enable = self.table.torque_enable  # The first address of the RAM.
    if address < enable.address and self._get(enable):
      return _ACCESS_ERROR
    before = bytes(self._memory)
    self._memory[address : address + len(data)] = data
    limits = {
      self.table.goal_current: self._get(self.table.current_limit),
      self.table.velocity: self._get(self.table.velocity_limit),
      self.table.acceleration: self._get(self.table.acceleration_limit),
      self.table.goal_position: 1150,
    }
    if any(self._get(field) > limit for field, limit in limits.items()):
      self._memory[:] = before
      return _LIMIT_ERROR
    return 0

  def receive(self, data: bytes) -> bytes:
    """Returns the answers to what arrived on the bus."""
    self._buffer += data
    packets = list(self._packets())
    return b"" if self.silent else b"".join(packets)

  def _packets(self) -> Iterator[bytes]:
    while (start := self._buffer.find(_HEADER)) >= 0:
      self._buffer = self._buffer[start:]
      size = 7 + int.from_bytes(self._buffer[5:7], "little")
      if len(self._buffer) < max(size, 10):
        return
      packet, self._buffer = self._buffer[:size], self._buffer[size:]
      if packet[4] in (DEVICE_ID, 0xFE):
        yield self._answer(packet)

  def _answer(self, packet: bytes) -> bytes:
    if crc(packet[:-2]) != int.from_bytes(packet[-2:], "little"):
      return self._status(_CRC_ERROR)
    instruction = packet[7]
    body = packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
    if instruction == _PING:
      return self._status(0, self.load(0, 2) + self.load(6, 1))
    address = int.from_bytes(body[:2], "little")
    if instruction == _READ:
      count = int.from_bytes(body[2:4], "little")
      return self._status(0, self.load(address, count))
    if instruction == _WRITE:
      return self._status(self.store(address, body[2:]))
    return self._status(_INSTRUCTION_ERROR)

  def _status(self, error: int, data: bytes = b"") -> bytes:
    alert = _ALERT if self._get(self.table.hardware_error) else 0
    body = bytes([_STATUS, error | alert]) + data
    body = body.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = _HEADER + bytes([DEVICE_ID]) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc(packet).to_bytes(2, "little")

  def _get(self, field: Field) -> int:
    return int.from_bytes(
      self._memory[field.address : field.address + field.size], "little"
    )

  def _set(self, field: Field, value: int) -> None:
    data = value.to_bytes(field.size, "little")
    self._memory[field.address : field.address + field.size] = data


def crc(data: bytes) -> int:
  """Returns the CRC-16 of protocol 2.0: polynomial 0x8005, initially 0."""
  value = 0
  for byte in data:
    value ^= byte << 8
    for _ in range(8):
      value = value << 1 ^ (0x8005 if value & 0x8000 else 0)
    value &= 0xFFFF
  return value


def open_terminal(receive: Callable[[bytes], bytes]) -> tuple[str, int, Callable]:
  """Opens a pseudo-terminal.

  Args:
    receive: Returns the answer to what a client wrote.

  Returns:
    The path for the client, the descriptor to watch, and what to call when there is
    something to read.
  """
  ours, theirs = os.openpty()  # ``theirs`` stays open, so that clients may come and go.
  tty.setraw(theirs)
  os.set_blocking(ours, False)

  def read() -> None:
    if answer := receive(os.read(ours, 4096)):
      os.write(ours, answer)

  return os.ttyname(theirs), ours, read
