"""The UR5e arm, by the package ``ur_rtde`` (an e-Series controller, PolyScope 5.6+).

Joint targets go by servoJ, one per control cycle of 2 ms. The controller holds the last
target if none follows. The wrench is ``actual_TCP_force`` of RTDE, which an e-Series
controller measures at the tool flange, in the axes of the base, without the payload,
positive where the surroundings push the tool. The ports are those of every controller
(dashboard 29999, script 30003, RTDE 30004); ``ur_rtde`` cannot change them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import threading
import time
from typing import Any, TypeVar

import numpy as np

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.drivers import vendor
from apnpql_jax.robot.drivers.ur_check import check_controller
from apnpql_jax.robot.protocols import ArmState

CYCLE = 0.002  # s
LOOKAHEAD = 0.03  # s, the least that servoJ takes
GAIN = 300.0  # of servoJ, in 100..2000
BRAKING = 4.0  # m/s^2 of the tool

_SILENCE = 0.2  # s without data after which the connection counts as lost
_AT_REST = 0.01  # rad/s
_PATIENCE = 5.0  # s for the controller to carry out a command
_VARIABLES = [
  *("timestamp", "actual_q", "actual_qd", "actual_TCP_force", "robot_mode"),
  *("safety_status_bits", "robot_status_bits", "target_speed_fraction"),
]
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

_T = TypeVar("_T")


class UR5e:
  """An ``Arm`` by RTDE."""

  def __init__(
    self,
    host: str,
    *,
    payload_kg: float,
    payload_cog_m: Sequence[float],
    lookahead_s: float = LOOKAHEAD,
    gain: float = GAIN,
  ):
    """Stores the settings; ``connect`` opens the connection.

    Args:
      host: Address of the controller.
      payload_kg: Mass of everything on the tool flange.
      payload_cog_m: Its center of gravity in the axes of the flange.
      lookahead_s: Of servoJ, 0.03 to 0.2.
      gain: Of servoJ, 100 to 2000.
    """
    self._host = host
    self._payload = float(payload_kg), [float(x) for x in payload_cog_m]
    self._servo = CYCLE, float(lookahead_s), float(gain)
    self._receive: Any = None
    self._control: Any = None
    self._about: dict[str, Any] = {}
    self._following = False
    self._clock = _Clock()

  def connect(self) -> None:
    """See ``protocols.Device``.

    Raises:
      DeviceError: Nothing answers, it is not a UR5e, it is not in remote control, or
        it is not ready to move.
    """
    receive = vendor("rtde_receive", "ur_rtde")
    control = vendor("rtde_control", "ur_rtde")
    dashboard = vendor("dashboard_client", "ur_rtde")
    self._about = check_controller(self._host, dashboard)
    try:
      self._receive = self._within(
        receive.RTDEReceiveInterface, self._host, 1 / CYCLE, _VARIABLES
      )
      self._control = self._within(control.RTDEControlInterface, self._host, 1 / CYCLE)
    except DeviceError:
      self.disconnect()
      raise
    self._clock = _Clock()
    if fault := self.get_observation().fault:
      self.disconnect()
      raise DeviceError(f"{self._host}: {fault}")

  def disconnect(self) -> None:
    """See ``protocols.Device``."""
    receive, control = self._receive, self._control
    if control and receive and not self._fault():
      with contextlib.suppress(DeviceError):
        self.stop()
    self._receive = self._control = None
    for call in (
      *((control.stopScript, control.disconnect) if control else ()),
      *((receive.disconnect,) if receive else ()),
    ):
      with contextlib.suppress(DeviceError):
        self._within(call)

  def describe(self) -> dict[str, Any]:
    """See ``protocols.Device``."""
    _, lookahead, gain = self._servo
    mass, center = self._payload
    servo = {"cycle_s": CYCLE, "lookahead_s": lookahead, "gain": gain}
    return {
      **self._about,
      "payload_kg": mass,
      "payload_cog_m": center,
      "servo_j": servo,
    }

  def get_observation(self) -> ArmState:
    """See ``protocols.Arm``; a lost connection is a fault, too."""
    source = self._connected()
    for _ in range(3):  # A package may arrive between two calls.
      stamp = source.getTimestamp()
      position, velocity = source.getActualQ(), source.getActualQd()
      wrench = source.getActualTCPForce()
      if source.getTimestamp() == stamp:
        break
    time_ = self._clock.local(stamp)
    return ArmState(
      time_, np.array(position), np.array(velocity), np.array(wrench), self._fault()
    )

  def send_action(self, position: np.ndarray) -> None:
    """See ``protocols.Arm``.

    Raises:
      DeviceError: The arm does not follow commands.
    """
    if not self._following:
      raise DeviceError(f"{self._host}: the arm follows commands only after start")
    if fault := self._fault():  # servoJ would reconnect, however long that takes.
      raise DeviceError(f"{self._host}: {fault}")
    joints = [float(x) for x in position]
    if not self._control.servoJ(joints, 0.0, 0.0, *self._servo):
      fault = self._fault() or "the controller refuses joint targets"
      raise DeviceError(f"{self._host}: {fault}")

  def stop(self) -> None:
    """See ``protocols.Arm``; waits until the arm is at rest."""
    try:
      if not self._following or self._fault():
        return  # The controller itself stops the arm.
      if not self._within(self._control.servoStop, BRAKING) and not self._fault():
        raise DeviceError(f"{self._host}: the controller does not end servoJ")
    finally:
      self._following = False
    self._wait_for_rest()

  def start(self) -> None:
    """See ``protocols.Arm``; sets the payload first.

    Raises:
      DeviceError: The arm moves, or the controller does not carry out a command.
    """
    if fault := self._fault():
      raise DeviceError(f"{self._host}: {fault}")
    source, control = self._connected(), self._control
    if (share := source.getTargetSpeedFraction()) < 1:
      raise DeviceError(
        f"{self._host}: the speed slider is at {share:.0%}: set it to 100%"
      )
    if not source.getRobotStatus() & _PROGRAM_RUNS:
      self._restart()
    self._wait_for_rest()
    self._command("payload", control.setPayload, *self._payload)
    self._command("zero of the force sensor", control.zeroFtSensor)
    self._following = True

  def _connected(self) -> Any:
    if self._receive is None:
      raise DeviceError(f"{self._host}: the arm is not connected")
    return self._receive

  def _fault(self) -> str:
    """Returns why the arm does not follow commands."""
    source = self._connected()
    silence = self._clock.silence(source.getTimestamp())
    if not source.isConnected() or silence > _SILENCE:
      return "lost the connection to the controller: check network and power"
    runs = source.getRobotStatus() & _PROGRAM_RUNS
    bits = source.getSafetyStatusBits()  # Read last, as it names the cause.
    if stops := [text for bit, text in _STOPS.items() if bits & bit]:
      return stops[0]
    if source.getRobotMode() != _POWERED:
      return "the arm is not powered: power it on and release the brakes"
    if self._following and not runs:
      return "the program on the controller stopped: check remote control, then start"
    return ""

  def _restart(self) -> None:
    """Sends the program again, which would obey the last command of the registers."""
    self._within(self._control.kickWatchdog)  # Clears the command.
    self._command("restart of the program", self._control.reuploadScript)
    end = time.monotonic() + _PATIENCE
    while not self._control.isProgramRunning():
      if time.monotonic() > end:
        raise DeviceError(f"{self._host}: the program on the controller does not start")
      time.sleep(CYCLE)

  def _wait_for_rest(self) -> None:
    end = time.monotonic() + _PATIENCE
    while np.abs(self._connected().getActualQd()).max() > _AT_REST:
      if fault := self._fault():
        raise DeviceError(f"{self._host}: {fault}")
      if time.monotonic() > end:
        raise DeviceError(f"{self._host}: the arm does not come to rest")
      time.sleep(CYCLE)

  def _command(self, name: str, call: Callable[..., bool], *args: Any) -> None:
    if not self._within(call, *args):
      reason = self._fault() or "see the log on the teach pendant"
      raise DeviceError(f"{self._host}: the controller refuses {name}: {reason}")

  def _within(self, call: Callable[..., _T], *args: Any) -> _T:
    """Returns the result of a call of ``ur_rtde``, which may wait for minutes.

    Raises:
      DeviceError: It fails, or takes longer than ``_PATIENCE``.
    """
    results: list[_T] = []
    errors: list[Exception] = []

    def run() -> None:
      try:
        results.append(call(*args))
      except Exception as error:  # ur_rtde raises several kinds.
        errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(_PATIENCE)
    if results:
      return results[0]
    reason = one_line(errors[0]) if errors else f"no answer within {_PATIENCE:g} s"
    raise DeviceError(f"{self._host}: {reason}")


class _Clock:
  """The controller's clock in terms of ``time.monotonic``.

  A package cannot arrive before it was sent, so the least difference of both clocks
  holds, but for their drift.
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
    """Returns how long this is the newest stamp, s."""
    now = time.monotonic()
    if stamp != self._last:
      drift = self._DRIFT * (now - self._arrival)
      self._offset = min(self._offset + drift, now - stamp)
      self._last, self._arrival = stamp, now
    return now - self._arrival
