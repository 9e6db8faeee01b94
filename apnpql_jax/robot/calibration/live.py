"""The devices of a cell that take views for its calibration."""

from __future__ import annotations

from collections.abc import Generator, Mapping
import contextlib
from typing import Any

from apnpql_jax.robot.calibration.views import MeasuredArm, NativeCamera
from apnpql_jax.robot.devices import connected

SIZE = 720, 1280
"""Height and width of views. D435 and D455 have this mode, and markers are small. The
pose of a camera is the same in all of its modes."""


@contextlib.contextmanager
def opened(
  contract: dict[str, Any], host: str, serials: Mapping[str, str]
) -> Generator[tuple[MeasuredArm, dict[str, NativeCamera]]]:
  """Connects the arm and the cameras, by their names in the contract.

  Args:
    contract: That of the policy.
    host: Address of the arm's controller.
    serials: Camera by its name -> its serial number.

  Raises:
    UserError: A device or a package is missing.
  """
  from apnpql_jax.robot.drivers.realsense import RealSense
  from apnpql_jax.robot.drivers.ur_listener import Listener

  arm = Listener(host)
  cameras: dict[str, NativeCamera] = {
    name: RealSense(serials[name], view=contract["cameras"][name], size=SIZE)
    for name in sorted(contract["cameras"], reverse=True)
  }
  with contextlib.ExitStack() as stack:
    for device in (arm, *cameras.values()):
      stack.enter_context(connected(device))
    yield arm, cameras
