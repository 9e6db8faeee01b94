"""The devices of a robot as the runtime sees them.

Method names are those of LeRobot's ``Robot``. Drivers raise ``errors.DeviceError`` with
one line when a device is missing, silent or another one than expected. All times are
those of ``time.monotonic``, in s. Angles are in rad, in the order of the contract's
``joints.state``. The control process and the drivers import no JAX.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

CAMERAS = ("global", "wrist")
"""Names of the cameras in the contract, in the order of all lists of cameras."""


@dataclasses.dataclass(frozen=True)
class ArmState:
  """A measurement of the arm."""

  time: float
  """When it was measured."""

  position: np.ndarray
  """Joint angles f64[6]."""

  velocity: np.ndarray
  """Joint velocities f64[6], rad/s."""

  wrench: np.ndarray
  """Force (N) and torque (N m) on the tool by its surroundings, f64[6].

  About the tool flange, in the axes of the base; without payload and bias.
  """

  fault: str = ""
  """Why the controller does not follow commands, such as a protective stop."""


@dataclasses.dataclass(frozen=True)
class GripperState:
  """A measurement of the gripper."""

  time: float
  """When it was measured."""

  angle: float
  """Angle of the driven finger, rad, 0 is open."""


@dataclasses.dataclass(frozen=True)
class Frame:
  """An image as the policy expects it: undistorted, cropped and resized."""

  time: float
  """When it was captured."""

  image: np.ndarray
  """RGB, rows from the top, u8[height, width, 3]."""


class Device(Protocol):
  """Interface of all devices."""

  def connect(self) -> None:
    """Opens the device; nothing moves."""
    ...

  def disconnect(self) -> None:
    """Closes the device, at rest; harmless if it is closed or lost."""
    ...

  def describe(self) -> dict[str, Any]:
    """Returns model, serial number, versions and settings, as JSON.

    ``check`` shows them, logs and calibrations keep them.
    """
    ...


class Arm(Device, Protocol):
  """A position-controlled arm with a wrist force-torque sensor."""

  def get_observation(self) -> ArmState:
    """Returns the newest measurement without waiting."""
    ...

  def send_action(self, position: np.ndarray) -> None:
    """Commands joint angles f64[6] for the next control cycle of 2 ms."""
    ...

  def stop(self) -> None:
    """Brakes to rest; the arm follows commands again after ``start``."""
    ...

  def start(self, *, zero: bool = True) -> None:
    """Makes the arm follow commands; with ``zero``, zeroes the wrench at rest first."""
    ...


class Gripper(Device, Protocol):
  """A gripper that opens or closes at a constant speed."""

  def get_observation(self) -> GripperState:
    """Returns the newest measurement without waiting."""
    ...

  def send_action(self, close: bool) -> None:
    """Closes or opens, without waiting; repeating a command changes nothing."""
    ...

  def hold(self) -> None:
    """Stops the fingers at their present angle, without waiting.

    Fingers that press on something thereby lose most of their force.
    """
    ...


class Camera(Device, Protocol):
  """A color camera."""

  def get_observation(self) -> Frame:
    """Returns the newest frame without waiting."""
    ...


class Judge(Protocol):
  """A judge that knows the whole scene, as no sensor of a real arm does."""

  def solved(self) -> bool:
    """Returns whether the task was solved at the newest frames."""
    ...

  def environment(self) -> np.ndarray:
    """Returns the state of the scene that the newest frames show, f32[k]."""
    ...

  def environment_names(self) -> list[str]:
    """Returns the names of the numbers in ``environment``."""
    ...
