"""The UR5e arm, by the package ``ur_rtde`` (an e-Series controller, PolyScope 5.6+).

Joint targets go by servoJ, one per control cycle of 2 ms. The program of ``ur_rtde`` on
the controller keeps the last target if none follows. So ``start`` sets a watchdog on
the controller: without a command for 0.5 s, it ends the program, and the arm comes to
rest. Between motions, ``get_observation`` feeds the watchdog, so that the program goes
on. If nobody reads the arm, it ends, and ``start`` sends it again.

The wrench is ``actual_TCP_force`` of RTDE, which an e-Series controller gives at the
tool flange, in the axes of the base, without the payload. Its sign, which no known
document states, is taken as that of the surroundings' push on the tool.

The ports are those of every controller (dashboard 29999, script 30003, RTDE 30004);
``ur_rtde`` cannot change them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import ctypes
import threading
import time
from typing import Any, TypeVar

import numpy as np

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.drivers.ur_check import check_controller
from apnpql_jax.robot.drivers.ur_state import VARIABLES, Reports
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import ArmState
from apnpql_jax.robot.vendors import vendor

LOOKAHEAD = 0.03  # s, the least that servoJ takes
GAIN = 300.0  # of servoJ, in 100..2000
BRAKING = 4.0  # m/s^2 of the tool
WATCHDOG = 2.0  # Hz of commands at least; servoStop brakes for 0.25 s without any

_PATIENCE = 5.0  # s for the controller to carry out a command
_FEED = 0.1  # s between two commands that feed the watchdog at rest

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
      payload_cog_m: Center of gravity of the payload in the axes of the flange.
      lookahead_s: Look-ahead time of servoJ, 0.03 to 0.2.
      gain: Gain of servoJ, 100 to 2000.
    """
    self._host = host
    self._payload = float(payload_kg), [float(x) for x in payload_cog_m]
    self._servo = TIMESTEP, float(lookahead_s), float(gain)
    self._receive: Any = None
    self._reports: Reports | None = None
    self._control: Any = None
    self._about: dict[str, Any] = {}
    self._following = False
    self._fed = 0.0

  def connect(self) -> None:
    """See ``protocols.Device``; harmless if it is connected.

    Raises:
      DeviceError: Nothing answers, it is not a UR5e, it is not in remote control, or
        it is not ready to move.
    """
    if self._reports:
      return
    receive = vendor("rtde_receive", "ur_rtde")
    control = vendor("rtde_control", "ur_rtde")
    dashboard = vendor("dashboard_client", "ur_rtde")
    self._about = check_controller(self._host, dashboard)
    try:
      self._receive = self._within(
        receive.RTDEReceiveInterface, self._host, 1 / TIMESTEP, VARIABLES
      )
      self._reports = Reports(self._host, self._receive)
      self._reports.check()  # First: the next line sends the program.
      self._control = self._within(
        control.RTDEControlInterface, self._host, 1 / TIMESTEP
      )
      # Never destroyed: its destructor ends the process if the connection is lost.
      ctypes.pythonapi.Py_IncRef(ctypes.py_object(self._control))
    except DeviceError:
      self.disconnect()
      raise

  def disconnect(self) -> None:
    """See ``protocols.Device``."""
    receive, control = self._receive, self._control
    calls = [receive.disconnect] if receive else []
    if control:
      calls.insert(0, control.disconnect)
      if receive.isConnected():  # Else it would try to reconnect.
        calls = [self.stop, control.stopScript, *calls]
    for call in calls:
      with contextlib.suppress(DeviceError):
        self._within(call)
    self._receive = self._reports = self._control = None

  def describe(self) -> dict[str, Any]:
    """See ``protocols.Device``."""
    _, lookahead, gain = self._servo
    mass, center = self._payload
    servo = {"cycle_s": TIMESTEP, "lookahead_s": lookahead, "gain": gain}
    return {
      **self._about,
      "payload_kg": mass,
      "payload_cog_m": center,
      "servo_j": servo,
    }

  def get_observation(self) -> ArmState:
    """See ``protocols.Arm``; a lost connection is a fault, too.

    At rest it feeds the watchdog, as targets do in motion.
    """
    reports = self._open()
    state = reports.measure(following=self._following)
    if not self._following and not state.fault and reports.program_runs:
      self._feed()
    return state

  def send_action(self, position: np.ndarray) -> None:
    """See ``protocols.Arm``.

    Raises:
      DeviceError: The arm does not follow commands.
    """
    if not self._following:
      raise DeviceError(f"{self._host}: the arm follows commands only after start")
    # In servoJ, ur_rtde would reconnect, however long that takes.
    if fault := self._fault():
      raise DeviceError(f"{self._host}: {fault}")
    joints = np.asarray(position, float)
    if joints.shape != (6,) or not np.isfinite(joints).all():
      raise DeviceError(f"{self._host}: {joints.tolist()} are not 6 joint angles")
    try:
      followed = self._control.servoJ(joints.tolist(), 0.0, 0.0, *self._servo)
    except Exception as error:  # ur_rtde raises several kinds.
      raise DeviceError(f"{self._host}: {one_line(error)}") from None
    if not followed:
      fault = self._fault() or "the controller refuses joint targets"
      raise DeviceError(f"{self._host}: {fault}")

  def stop(self) -> None:
    """See ``protocols.Arm``; waits until the arm is at rest."""
    moves = self._following and not self._fault()
    if moves and not self._within(self._control.servoStop, BRAKING):
      moves = False
      if not self._fault():
        raise DeviceError(f"{self._host}: the controller does not end servoJ")
    self._following = False  # A fault stops the arm by itself.
    if moves:
      self._open().wait_for_rest()

  def start(self, *, zero: bool = True) -> None:
    """See ``protocols.Arm``; sets the payload first, and the watchdog.

    Raises:
      DeviceError: The arm moves, or the controller does not carry out a command.
    """
    reports, control = self._open(), self._control
    reports.check()
    if slowed := reports.slowed:
      raise DeviceError(f"{self._host}: {slowed}")
    if not reports.program_runs:
      self._restart()
    reports.wait_for_rest()
    self._command("payload", control.setPayload, *self._payload)
    if zero:
      self._command("zero of the force sensor", control.zeroFtSensor)
    reports.wait_for_news()  # Older measurements have the old zero.
    self._command("the watchdog", control.setWatchdog, WATCHDOG)
    self._following = True

  def _open(self) -> Reports:
    if self._reports is None:
      raise DeviceError(f"{self._host}: the arm is not connected")
    return self._reports

  def _fault(self) -> str:
    return self._open().fault(following=self._following)

  def _feed(self) -> None:
    """Feeds the watchdog, as each command does, with the command to do nothing."""
    now = time.monotonic()
    if now - self._fed > _FEED:
      self._fed = now
      with contextlib.suppress(Exception):  # What fails is a fault soon.
        self._control.kickWatchdog()

  def _restart(self) -> None:
    """Clears the last command, which the program would obey, and sends it again."""
    self._within(self._control.kickWatchdog)  # Clears the command.
    self._command("restart of the program", self._control.reuploadScript)
    end = time.monotonic() + _PATIENCE
    while not self._control.isProgramRunning():
      if time.monotonic() > end:
        raise DeviceError(f"{self._host}: the program on the controller does not start")
      time.sleep(TIMESTEP)

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
