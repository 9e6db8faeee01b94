"""Reports of a UR controller by RTDE: measurements, faults and the time of both."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import ArmState

VARIABLES = [
  *("timestamp", "actual_q", "actual_qd", "actual_TCP_force", "robot_mode"),
  *("safety_status_bits", "robot_status_bits", "target_speed_fraction"),
]

_SILENCE = 0.2  # s without data after which the connection counts as lost
_AT_REST = 0.01  # rad/s
_PATIENCE = 5.0  # s for the arm to come to rest
_PROGRAM_RUNS = 1 << 1  # of robot_status_bits
_POWERED = 7  # robot_mode RUNNING
_STOPS = {
  1 << 2: "protective stop: clear the collision and unlock it on the teach pendant",
  1 << 3: "recovery mode: move the arm within its limits on the teach pendant",
  1 << 4: "safeguard stop: close the safeguard and reset it",
  1 << 5: "emergency stop of the system: release it and power the arm on",
  1 << 6: "emergency stop of the robot: release it and power the arm on",
  1 << 7: "emergency stop: release it and power the arm on",
  1 << 8: "safety violation: restart the safety system on the teach pendant",
  1 << 9: "safety fault: restart the controller",
  1 << 10: "stopped for safety: see the teach pendant",
}
"""Bits of safety_status_bits (RTDE guide of Universal Robots)."""


class Reports:
  """The reports of a controller, by ``RTDEReceiveInterface`` of ``ur_rtde``."""

  def __init__(self, host: str, source: Any):
    """Starts to follow the controller's clock; ``source`` is the vendor's client."""
    self._host, self._source = host, source
    self._clock = ControllerClock()

  @property
  def connected(self) -> bool:
    """Whether the connection stands."""
    return self._source.isConnected()

  @property
  def program_runs(self) -> bool:
    """Whether a program runs on the controller."""
    return bool(self._source.getRobotStatus() & _PROGRAM_RUNS)

  @property
  def slowed(self) -> str:
    """Why the arm would follow its targets too slowly, or an empty string."""
    share = self._source.getTargetSpeedFraction()
    return "" if share >= 1 else f"the speed slider is at {share:.0%}: set it to 100%"

  def measure(self, *, following: bool) -> ArmState:
    """Returns the newest measurement; see ``fault``."""
    source = self._source
    for _ in range(3):  # A package may arrive between two calls.
      stamp = source.getTimestamp()
      position, velocity = source.getActualQ(), source.getActualQd()
      wrench = source.getActualTCPForce()
      if source.getTimestamp() == stamp:
        break
    when, fault = self._clock.local(stamp), self.fault(following=following)
    return ArmState(
      when, np.array(position), np.array(velocity), np.array(wrench), fault
    )

  def fault(self, *, following: bool) -> str:
    """Returns why the arm does not follow commands.

    Args:
      following: Whether it should follow now: then a stopped program is a fault, too.
    """
    source = self._source
    silence = self._clock.silence(source.getTimestamp())
    if not source.isConnected() or silence > _SILENCE:
      return "lost the connection to the controller: check network and power"
    runs = self.program_runs
    bits = source.getSafetyStatusBits()  # Read last, as it names the cause.
    if stops := [text for bit, text in _STOPS.items() if bits & bit]:
      return stops[0]
    if source.getRobotMode() != _POWERED:
      return "the arm is not powered: power it on and release the brakes"
    if following and not runs:
      return "the program on the controller stopped: check remote control, then start"
    return ""

  def check(self) -> None:
    """Raises ``DeviceError`` if there is a fault."""
    if fault := self.fault(following=False):
      raise DeviceError(f"{self._host}: {fault}")

  def wait_for_rest(self) -> None:
    """Waits until the arm stands still.

    Raises:
      DeviceError: It does not, or there is a fault.
    """
    end = time.monotonic() + _PATIENCE
    while np.abs(self._source.getActualQd()).max() > _AT_REST:
      self.check()
      if time.monotonic() > end:
        raise DeviceError(f"{self._host}: the arm does not come to rest")
      time.sleep(TIMESTEP)

  def wait_for_news(self) -> None:
    """Waits for a measurement of one of the next cycles.

    Raises:
      DeviceError: There is a fault.
    """
    now = time.monotonic()
    while self._clock.local(self._source.getTimestamp()) < now + 2 * TIMESTEP:
      self.check()
      time.sleep(TIMESTEP)


class ControllerClock:
  """The controller's clock in terms of ``time.monotonic``.

  A packet cannot arrive before it was sent. So the smallest difference of both clocks
  is used, corrected for their drift.
  """

  _DRIFT = 1e-4  # s per s, more than that of quartz clocks

  def __init__(self) -> None:
    self._offset = np.inf
    self._last, self._arrival = -1.0, time.monotonic()

  def local(self, stamp: float) -> float:
    """Returns the local time of a stamp of the controller, s."""
    self.silence(stamp)
    return stamp + self._offset

  def silence(self, stamp: float) -> float:
    """Returns how long ``stamp`` has been the newest one, s."""
    now = time.monotonic()
    if stamp != self._last:
      drift = self._DRIFT * (now - self._arrival)
      self._offset = min(self._offset + drift, now - stamp)
      self._last, self._arrival = stamp, now
    return now - self._arrival
