"""Control tables and geometry of the grippers RH-P12-RN and RH-P12-RN(A).

The tables are those of the manufacturer's e-Manual (emanual.robotis.com, pages
``rh_p12_rn`` and ``rh_p12_rna``). Both grippers are the same mechanics with different
firmware. A tick of the encoder is 1/4096 of a turn of the driven finger; the e-Manual
shows ticks 0 (open) and 740 (closed). Velocities are those of the finger, too. (The
file ``rh_p12_rn.model`` of the manufacturer's ROS 2 driver gives the unit of the old
firmware for the new one, which would make its velocity limit 340 rev/min. It also maps
740 ticks to 1.099 rad, 3 % less than the encoder's 12 bits per turn give.)
"""

from __future__ import annotations

import dataclasses
import math

from apnpql_jax.sim.motors import FINGER_ANGLE, FINGER_LENGTH, GRIPPER_SPEED

TICK = 2 * math.pi / 4096  # rad
OPEN, CLOSED = 0, 740  # ticks
PAD_OFFSET = 0.0041  # m, as in the contract's ``pad_gap_m``
_RPM = 2 * math.pi / 60  # rad/s
MAX_FORCE = 170.0  # N at the largest current, data sheet

ERRORS = {
  1 << 0: "the supply voltage is out of range",
  1 << 2: "it is too hot",
  1 << 3: "its encoder fails",
  1 << 4: "its supply is too weak, or it had an electric shock",
  1 << 5: "it is overloaded",
}
"""Bits of the hardware error status, which the table of Shutdown explains."""


@dataclasses.dataclass(frozen=True)
class Field:
  """An entry of a control table."""

  address: int
  size: int  # bytes, little-endian


@dataclasses.dataclass(frozen=True)
class Table:
  """The part of a control table that the driver needs."""

  name: str
  model_number: int
  rpm: float  # unit of velocities
  milliamperes: float  # unit of currents
  largest_current: int  # units
  current_limit: Field
  velocity_limit: Field
  acceleration_limit: Field
  torque_enable: Field
  goal_current: Field
  acceleration: Field
  velocity: Field  # of the profile
  goal_position: Field
  present_position: Field
  hardware_error: Field
  operating_mode: Field = Field(11, 1)
  firmware: Field = Field(6, 1)

  def speed(self, angle: float) -> int:
    """Returns ``finger_speed`` at an angle (rad, clipped) in units of velocities."""
    inside = min(max(angle, OPEN * TICK), CLOSED * TICK)
    return round(finger_speed(inside) / (self.rpm * _RPM))

  def current(self, share: float) -> int:
    """Returns a share of the largest current in units of currents."""
    return round(share * self.largest_current)


POSITION_MODE = 5  # "current-based position control"

RN = Table(
  name="RH-P12-RN",
  model_number=35073,
  rpm=0.114,
  milliamperes=4.02,
  largest_current=820,
  acceleration_limit=Field(26, 4),
  current_limit=Field(30, 2),
  velocity_limit=Field(32, 4),
  torque_enable=Field(562, 1),
  goal_position=Field(596, 4),
  velocity=Field(600, 4),
  goal_current=Field(604, 2),
  acceleration=Field(606, 4),
  present_position=Field(611, 4),
  hardware_error=Field(892, 1),
)
RNA = Table(
  name="RH-P12-RN(A)",
  model_number=35074,
  rpm=0.01,
  milliamperes=1.0,
  largest_current=1984,
  current_limit=Field(38, 2),
  acceleration_limit=Field(40, 4),
  velocity_limit=Field(44, 4),
  torque_enable=Field(512, 1),
  hardware_error=Field(518, 1),
  goal_current=Field(550, 2),
  acceleration=Field(556, 4),
  velocity=Field(560, 4),
  goal_position=Field(564, 4),
  present_position=Field(580, 4),
)
TABLES = {table.model_number: table for table in (RN, RNA)}


def pad_gap(angle: float) -> float:
  """Returns the gap between the pads, m, at an angle of the driven finger, rad."""
  return 2 * (PAD_OFFSET + FINGER_LENGTH * math.cos(angle + FINGER_ANGLE))


def finger_speed(angle: float) -> float:
  """Returns the finger's velocity, rad/s, at which the gap changes by 75 mm/s."""
  return GRIPPER_SPEED / (2 * FINGER_LENGTH * math.sin(angle + FINGER_ANGLE))


def torque(current_share: float) -> float:
  """Returns the torque of the driven finger, N m, at a share of the largest current.

  The manual relates no current to a force; this takes the force at closed fingers as
  proportional to the current.
  """
  return current_share * MAX_FORCE * 2 * FINGER_LENGTH
