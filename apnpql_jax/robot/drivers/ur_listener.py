"""A UR5e that is only read, while the teach pendant has control."""

from __future__ import annotations

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.drivers import ur5e, vendor
from apnpql_jax.robot.drivers.ur_check import check_rtde


class Listener(ur5e.UR5e):
  """An arm whose joint angles are read, such as in free drive; it takes no commands."""

  def __init__(self, host: str):
    """Stores the address; ``connect`` opens the connection."""
    super().__init__(host, payload_kg=0.0, payload_cog_m=(0.0, 0.0, 0.0))

  def connect(self) -> None:
    """See ``protocols.Device``; in local and in remote control.

    Raises:
      DeviceError: Nothing answers.
    """
    check_rtde(self._host)
    receive = vendor("rtde_receive", "ur_rtde")
    self._receive = self._within(
      receive.RTDEReceiveInterface, self._host, 1 / ur5e.CYCLE, ur5e._VARIABLES
    )
    self._clock = ur5e._Clock()

  def start(self) -> None:
    """Raises ``DeviceError``."""
    raise DeviceError(f"{self._host}: this connection only reads")
