"""A UR controller that is only read: in free drive, or before a run."""

from __future__ import annotations

import contextlib
from typing import Any

from apnpql_jax.errors import DeviceError, one_line
from apnpql_jax.robot.drivers.ur_check import LOCAL, check_rtde, identify
from apnpql_jax.robot.drivers.ur_state import VARIABLES, Reports
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.protocols import ArmState
from apnpql_jax.robot.vendors import vendor


class Listener:
  """An arm that is measured, such as in free drive; it takes no commands."""

  def __init__(self, host: str):
    """Stores the address; ``connect`` opens the connection."""
    self._host = host
    self._receive: Any = None
    self._reports: Reports | None = None

  def connect(self) -> None:
    """See ``protocols.Device``; in local and in remote control.

    Raises:
      DeviceError: Nothing answers, or another device than expected.
    """
    receive = vendor("rtde_receive", "ur_rtde")
    self._identify()
    try:
      self._receive = receive.RTDEReceiveInterface(self._host, 1 / TIMESTEP, VARIABLES)
    except Exception as error:  # ur_rtde raises several kinds.
      raise DeviceError(f"{self._host}: {one_line(error)}") from None
    self._reports = Reports(self._host, self._receive)

  def disconnect(self) -> None:
    """See ``protocols.Device``."""
    receive, self._receive, self._reports = self._receive, None, None
    with contextlib.suppress(Exception):  # Whatever a lost connection raises.
      if receive:
        receive.disconnect()

  def describe(self) -> dict[str, Any]:
    """See ``protocols.Device``."""
    return {"host": self._host}

  def get_observation(self) -> ArmState:
    """See ``protocols.Arm``.

    Raises:
      DeviceError: The connection is lost.
    """
    if self._reports is None or not self._reports.connected:
      raise DeviceError(f"{self._host}: lost the connection: check network and power")
    return self._reports.measure(following=False)

  def _identify(self) -> None:
    """Raises ``DeviceError`` unless a controller answers."""
    check_rtde(self._host)


class Inspector(Listener):
  """An arm before a run: what it is, and what would keep it from following.

  It sends no program, unlike the arm of a run, and connects to a UR5e only.
  """

  _about: dict[str, Any] | None = None
  _remote = False

  def describe(self) -> dict[str, Any]:
    """See ``protocols.Device``."""
    return dict(self._about or {})

  def problems(self) -> list[str]:
    """Returns what is to be changed at the teach pendant, besides faults."""
    found = [] if self._remote else [LOCAL]
    if self._reports is not None and (slowed := self._reports.slowed):
      found.append(slowed)
    return found

  def _identify(self) -> None:
    """Raises ``DeviceError`` unless a UR5e answers."""
    dashboard = vendor("dashboard_client", "ur_rtde")
    self._about, self._remote = identify(self._host, dashboard)
