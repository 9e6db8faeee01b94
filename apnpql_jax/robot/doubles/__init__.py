"""Doubles of the devices, to which the vendors' own clients connect.

They speak the devices' protocols, with one MuJoCo scene behind all of them, so that a
whole run can be rehearsed without hardware, and each fault can be caused.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import dataclasses
import itertools
import os
from typing import Any

from apnpql_jax.robot.devices import connected
from apnpql_jax.robot.doubles.cameras import cameras
from apnpql_jax.robot.doubles.child import Child
from apnpql_jax.robot.doubles.server import ask
from apnpql_jax.robot.drivers.gripper import RHP12RN
from apnpql_jax.robot.drivers.realsense import RealSense
from apnpql_jax.robot.drivers.rh_p12_rn import RNA
from apnpql_jax.robot.drivers.ur5e import UR5e

PAYLOAD_KG = 0.488
"""Gripper and camera in the scenes."""

PAYLOAD_COG_M = (-0.006, 0.0, 0.048)
_COUNT = itertools.count()


@dataclasses.dataclass
class Doubles:
  """The devices, connected through their drivers."""

  host: str
  """Address of the processes behind them."""

  arm: UR5e
  gripper: RHP12RN
  cameras: dict[str, RealSense]

  def ask(self, name: str) -> Any:
    """Causes a fault, or returns the true "state": a method of ``server.Remote``."""
    return ask(self.host, name)


@contextlib.contextmanager
def start(
  task: str, contract: dict[str, Any] | None = None, **settings: Any
) -> Generator[Doubles]:
  """Starts the doubles and connects the drivers to them, all in this process.

  Args:
    task: Name of the task, or path of its MJCF file.
    contract: That of the policy, see ``deploy.contract``; without it, no cameras.
    settings: See ``serve``.

  Raises:
    UserError: A package is missing, or a double cannot start.
  """
  with contextlib.ExitStack() as stack:
    server = serve(task, **settings)
    stack.callback(server.close)
    host, terminal = server.greeting
    arm = UR5e(host, payload_kg=PAYLOAD_KG, payload_cog_m=PAYLOAD_COG_M)
    gripper = RHP12RN(terminal)
    eyes = stack.enter_context(cameras(host, task, contract)) if contract else {}
    for device in (arm, gripper, *eyes.values()):
      stack.enter_context(connected(device))
    yield Doubles(host, arm, gripper, eyes)


def serve(
  task: str,
  *,
  noise: bool = True,
  gripper: int = RNA.model_number,
  model_number: int | None = None,
  modbus: bool = False,
  **controller: Any,
) -> Child:
  """Starts the doubles of arm and gripper; greets with address and serial port.

  Args:
    task: Name of the task, or path of its MJCF file.
    noise: Whether the force-torque sensor is noisy.
    gripper: Model number of the gripper.
    model_number: The number that it reports, if another one.
    modbus: Whether the gripper speaks Modbus-RTU.
    controller: Arguments of ``controller.Controller``.
  """
  settings = {
    "scene": task,
    "host": address(os.getpid(), next(_COUNT)),
    "noise": noise,
    "gripper": gripper,
    "model_number": model_number,
    "modbus": modbus,
    "controller": controller,
  }
  return Child("apnpql_jax.robot.doubles.server", settings)


def address(process: int, count: int) -> str:
  """Returns the loopback address of the doubles that a process starts, from 0 on.

  Each has its own, as the ports are fixed.
  """
  return f"127.{process // 250 % 250 + 1}.{process % 250 + 1}.{count % 250 + 1}"
