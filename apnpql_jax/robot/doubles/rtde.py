"""RTDE, version 2: the messages by which a UR controller exchanges data.

As in the real-time data exchange (RTDE) guide of Universal Robots, a message is its
length (u16, the header of 3 bytes included), its type (a letter) and a payload, all
numbers big-endian. Clients ask for recipes of named variables, receive one package of
outputs per cycle, and write packages of input registers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import struct
from typing import Any

HEADER = struct.Struct(">HB")
TYPES = {
  "DOUBLE": "d",
  "UINT64": "Q",
  "UINT32": "I",
  "INT32": "i",
  "VECTOR3D": "3d",
  "VECTOR6D": "6d",
  "VECTOR6INT32": "6i",
}
"""Type of a variable -> its format in ``struct``."""

_NAMES = {
  "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction "
  "actual_momentum actual_main_voltage actual_robot_voltage actual_robot_current "
  "standard_analog_input0 standard_analog_input1 standard_analog_output0 "
  "standard_analog_output1 payload speed_scaling_combined",
  "UINT64": "actual_digital_input_bits actual_digital_output_bits",
  "UINT32": "runtime_state robot_status_bits safety_status_bits",
  "INT32": "robot_mode safety_mode",
  "VECTOR3D": "actual_tool_accelerometer payload_cog",
  "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q "
  "actual_qd actual_current joint_control_output actual_TCP_pose actual_TCP_speed "
  "actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures "
  "actual_joint_voltage ft_raw_wrench payload_inertia actual_current_as_torque",
  "VECTOR6INT32": "joint_mode",
}
KINDS = {name: kind for kind, names in _NAMES.items() for name in names.split()}
"""Variable of the controller -> its type; registers are not listed."""

_REGISTERS = {"int": "INT32", "double": "DOUBLE", "bit": "BOOL"}


def kind_of(name: str) -> str:
  """Returns the type of a variable or register, or NOT_FOUND."""
  words = name.split("_")
  if len(words) == 4 and words[0] in ("input", "output") and words[2] == "register":
    return _REGISTERS.get(words[1], "NOT_FOUND")
  return KINDS.get(name, "NOT_FOUND")


class RtdeSession:
  """One client of the server: its recipes, and whether it receives outputs."""

  def __init__(self, version: tuple[int, int, int, int], write: Callable[..., None]):
    """Starts without recipes; ``write`` takes a dict of input registers."""
    self._version, self._write = version, write
    self._inputs: list[tuple[list[str], struct.Struct]] = []
    self._outputs: list[str] = []
    self._layout = struct.Struct(">B")
    self._buffer = b""
    self.started = False

  def receive(self, data: bytes) -> bytes:
    """Returns the answers to what a client sent.

    Raises:
      ValueError: It is not RTDE.
    """
    self._buffer += data
    return b"".join(self._answer(kind, body) for kind, body in self._messages())

  def package(self, values: Mapping[str, Any]) -> bytes:
    """Returns the data package of one cycle; variables without a value are zero."""
    flat: list[Any] = [1]
    for name in self._outputs:
      count = struct.Struct(">" + TYPES[kind_of(name)])
      value = values.get(name)
      if value is None:
        flat += count.unpack(bytes(count.size))
      elif isinstance(value, (int, float)):
        flat.append(value)
      else:
        flat += value
    return _message("U", self._layout.pack(*flat))

  def _messages(self) -> Iterator[tuple[str, bytes]]:
    while len(self._buffer) >= HEADER.size:
      size, kind = HEADER.unpack_from(self._buffer)
      if size < HEADER.size or size > 4096:
        raise ValueError("not RTDE")
      if len(self._buffer) < size:
        return
      body, self._buffer = self._buffer[HEADER.size : size], self._buffer[size:]
      yield chr(kind), body

  def _answer(self, kind: str, body: bytes) -> bytes:
    if kind == "V":
      return _message(kind, struct.pack(">?", struct.unpack(">H", body)[0] == 2))
    if kind == "v":
      return _message(kind, struct.pack(">4I", *self._version))
    if kind == "O":
      self._outputs, types, self._layout = _recipe(body[8:])
      return _message(kind, b"\1" + ",".join(types).encode())
    if kind == "I":
      names, types, layout = _recipe(body)
      self._inputs.append((names, layout))
      return _message(kind, bytes([len(self._inputs)]) + ",".join(types).encode())
    if kind in "SP":
      self.started = kind == "S"
      return _message(kind, b"\1")
    if kind == "U" and 0 < body[0] <= len(self._inputs):
      names, layout = self._inputs[body[0] - 1]
      self._write(dict(zip(names, layout.unpack(body)[1:], strict=True)))
      return b""
    raise ValueError("not RTDE")


def _recipe(body: bytes) -> tuple[list[str], list[str], struct.Struct]:
  """Returns names and types of a recipe, and the layout of its packages."""
  names = [name for name in body.decode("ascii").split(",") if name]
  types = [kind_of(name) for name in names]
  known = [TYPES[kind] for kind in types if kind in TYPES]
  return names, types, struct.Struct(">B" + "".join(known))


def _message(kind: str, body: bytes) -> bytes:
  return HEADER.pack(HEADER.size + len(body), ord(kind)) + body
