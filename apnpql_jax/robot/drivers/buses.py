"""The buses on which a gripper can be: Dynamixel protocol 2.0 and Modbus-RTU.

An RH-P12-RN(A) speaks either, as its Protocol Type(13) says. The manufacturer does not
publish the registers of Modbus. Those who use it (the project
``Doosan-E0509-ROBOTIS-RH-P12-RN-TCP-Bridge`` on GitHub) find the bytes of addresses 2n
and 2n + 1 of the control table in register n, low byte first.

At 57,600 baud, a reading of four bytes takes 5.5 ms on the line: 29 bytes, and up to
0.5 ms before the gripper answers. A USB adapter by FTDI hands bytes over every 16 ms
unless its latency timer is set lower. So an answer arrives within 22 ms. Both buses
wait about 37 ms for it and try three times: a silent line is an error within 0.12 s.

Answers do not say which request they belong to. So a late answer to a first attempt
passes for the answer to the second, which is still to come. Both buses wait for that
one and discard it; otherwise it would pass for the answer to the next request, which
reads another address.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import importlib
import os
import time
from typing import Any, Protocol

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.vendors import vendor

ATTEMPTS = 3  # without an answer, after which the gripper counts as lost
_ANSWER_S = 0.037  # for one answer by Modbus; the SDK waits as long for four bytes
_READ_S = 0.002  # for some bytes of an answer by the SDK
_SILENT = "it does not answer: check its power and cable"


class Silent(DeviceError):
  """The error that nothing answers on the bus."""


class Bus(Protocol):
  """Access to the bytes of a control table."""

  name: str

  def read(self, address: int, size: int) -> bytes:
    """Returns bytes of the control table; raises ``DeviceError``."""
    ...

  def write(self, address: int, data: bytes) -> None:
    """Writes bytes of the control table; raises ``DeviceError``."""
    ...

  def close(self) -> None:
    """Closes the port."""
    ...


class Dynamixel:
  """A bus that speaks Dynamixel protocol 2.0, by ``dynamixel-sdk``."""

  name = "Dynamixel 2.0"

  def __init__(self, port: str, baud: int, device_id: int):
    """Opens the port.

    Raises:
      DeviceError: The port cannot be opened, or the package is missing.
    """
    sdk = vendor("dynamixel_sdk", "dynamixel-sdk")
    self._success, self._damaged = sdk.COMM_SUCCESS, sdk.ERRNUM_CRC
    self._where, self._id = port, device_id
    self._port, self._packets = sdk.PortHandler(port), sdk.PacketHandler(2.0)
    try:
      self._port.setBaudRate(baud)  # Opens the port.
      # The SDK's own value of zero would keep a core busy until an answer is there.
      self._port.ser.timeout = _READ_S
    except Exception as error:  # Those of pyserial, and of termios.
      raise DeviceError(f"could not open port {port}: {_cause(error)}") from None

  def read(self, address: int, size: int) -> bytes:
    """See ``Bus``."""
    (data,) = self._try("read", self._packets.readTxRx, address, size)
    if len(data) != size:
      raise DeviceError(
        f"{self._where}: it answers {len(data)} bytes of {size} at {address}"
      )
    return bytes(data)

  def write(self, address: int, data: bytes) -> None:
    """See ``Bus``."""
    self._try("write", self._packets.writeTxRx, address, len(data), list(data))

  def close(self) -> None:
    """See ``Bus``."""
    self._port.closePort()

  def _try(
    self, verb: str, call: Callable[..., tuple], address: int, *args: Any
  ) -> list[Any]:
    """Returns what a call of the SDK returns before its result and error.

    It tries again if either packet was damaged on its way. The gripper reports a
    damaged instruction in an intact answer without data.
    """
    for attempt in range(ATTEMPTS):
      try:
        *found, result, error = call(self._port, self._id, address, *args)
      except Exception as failure:  # Those of pyserial, and of termios.
        raise DeviceError(f"{self._where}: {_cause(failure)}") from None
      error &= 0x7F  # Bit 7 is for hardware errors, which are read separately.
      if result != self._success or error == self._damaged:
        continue
      if error:
        reason = one_line(Exception(self._packets.getRxPacketError(error)))
        raise DeviceError(f"{self._where}: it refuses to {verb} {address}: {reason}")
      _await_late_answers(attempt)
      return found
    raise Silent(f"{self._where}: {_SILENT}")


class Modbus:
  """A bus that speaks Modbus-RTU, by ``pymodbus``."""

  name = "Modbus-RTU"

  def __init__(self, port: str, baud: int, device_id: int):
    """Opens the port.

    Raises:
      DeviceError: The port cannot be opened, or the package is missing.
    """
    client = vendor("pymodbus.client", "pymodbus").ModbusSerialClient
    self._failure = importlib.import_module("pymodbus.exceptions").ModbusException
    self._where, self._id = port, device_id
    self._client = client(port, baudrate=baud, timeout=_ANSWER_S, retries=0)
    if not self._client.connect():
      raise DeviceError(f"could not open port {port}")

  def read(self, address: int, size: int) -> bytes:
    """See ``Bus``."""
    first, end = address // 2, (address + size + 1) // 2
    answer = self._try(self._client.read_holding_registers, first, count=end - first)
    data = b"".join(x.to_bytes(2, "little") for x in answer.registers)
    start = address - 2 * first
    return data[start : start + size]

  def write(self, address: int, data: bytes) -> None:
    """See ``Bus``; the rest of the first and the last register stays."""
    first, end = address // 2, (address + len(data) + 1) // 2
    if address % 2 or len(data) % 2:
      whole = bytearray(self.read(2 * first, 2 * (end - first)))
      whole[address - 2 * first : address - 2 * first + len(data)] = data
      data = bytes(whole)
    words = [int.from_bytes(data[i : i + 2], "little") for i in range(0, len(data), 2)]
    self._try(self._client.write_registers, first, words)

  def close(self) -> None:
    """See ``Bus``."""
    self._client.close()

  def _try(self, call: Callable[..., Any], first: int, *args: Any, **named: Any) -> Any:
    for attempt in range(ATTEMPTS):
      with contextlib.suppress(self._failure):
        answer = call(first, *args, device_id=self._id, **named)
        if answer.isError():
          raise DeviceError(
            f"{self._where}: it refuses register {first}: {one_line(Exception(answer))}"
          )
        _await_late_answers(attempt)
        return answer
    raise Silent(f"{self._where}: {_SILENT}")


def _await_late_answers(attempt: int) -> None:
  """Waits after a repeated attempt; the next request discards what has arrived."""
  if attempt > 0:
    time.sleep(_ANSWER_S)


def _cause(error: Exception) -> str:
  """Returns why a port fails, in words of the system if it gives a number."""
  number = getattr(error, "errno", None)
  return os.strerror(number) if number else one_line(error)
