"""Modbus-RTU for the double of the gripper, see ``drivers.buses``.

Functions 3 (read holding registers) and 16 (write registers) of Modbus' application
protocol. A frame arrives in one piece, as a client writes it.
"""

from __future__ import annotations

import struct

from apnpql_jax.robot.doubles.dynamixel import DEVICE_ID, Gripper

_READ, _WRITE = 3, 16
_ERROR, _ILLEGAL_FUNCTION, _ILLEGAL_VALUE = 0x80, 1, 3


def answer(gripper: Gripper, frame: bytes) -> bytes:
  """Returns the answer to a frame; none to what is not one for this device."""
  if gripper.silent or len(frame) < 8 or frame[0] != DEVICE_ID:
    return b""
  if crc(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
    return b""
  function, first, count = struct.unpack_from(">BHH", frame, 1)
  body = b""
  if function == _READ:
    words = struct.unpack(f"<{count}H", gripper.load(2 * first, 2 * count))
    body = struct.pack(f">B{count}H", 2 * count, *words)
  elif function == _WRITE:
    words = struct.unpack_from(f">{count}H", frame, 7)
    error = gripper.store(2 * first, struct.pack(f"<{count}H", *words))
    body = struct.pack(">HH", first, count)
    if error:
      function, body = function | _ERROR, bytes([_ILLEGAL_VALUE])
  else:
    function, body = function | _ERROR, bytes([_ILLEGAL_FUNCTION])
  reply = bytes([DEVICE_ID, function]) + body
  return reply + crc(reply).to_bytes(2, "little")


def crc(data: bytes) -> int:
  """Returns the CRC-16 of Modbus: polynomial 0x8005 reflected, initially all ones."""
  value = 0xFFFF
  for byte in data:
    value ^= byte
    for _ in range(8):
      value = value >> 1 ^ (0xA001 if value & 1 else 0)
  return value
