"""Doubles of the devices, to which the vendors' own clients connect.

They speak the devices' protocols, with one MuJoCo scene behind all of them, so that a
whole run can be rehearsed without hardware, and each fault can be caused.
"""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import itertools
import os
from typing import Any

from apnpql_jax.robot.doubles.child import Child
from apnpql_jax.robot.drivers.gripper import RHP12RN, connect
from apnpql_jax.robot.drivers.rh_p12_rn import RNA
from apnpql_jax.robot.drivers.ur5e import UR5e

PAYLOAD_KG = 0.488
"""Gripper and camera in the scenes."""

PAYLOAD_COG_M = (0.0, 0.0, 0.05)
_COUNT = itertools.count()


class Doubles:
  """The devices, connected through their drivers, and their faults."""

  def __init__(self, server: Child, arm: UR5e, gripper: RHP12RN):
    """Keeps the devices and the process behind them."""
    self._server = server
    self.arm, self.gripper = arm, gripper

  def drop_rtde(self) -> None:
    """Cuts the connection to the arm for good."""
    self._server.ask("drop_rtde")

  def protective_stop(self) -> None:
    """Stops the arm as after a collision."""
    self._server.ask("protective_stop")

  def emergency_stop(self) -> None:
    """Stops the arm as if the button was pushed."""
    self._server.ask("emergency_stop")

  def stop_program(self) -> None:
    """Ends the program on the controller, as the teach pendant can."""
    self._server.ask("stop_program")

  def silence_gripper(self) -> None:
    """Makes the gripper ignore its bus, as without power."""
    self._server.ask("silence_gripper")

  def fail_gripper(self) -> None:
    """Makes the gripper report an overload."""
    self._server.ask("fail_gripper")

  def state(self) -> dict[str, Any]:
    """Returns the plant's true state: position, target, finger, qpos, mocap poses."""
    return self._server.ask("state")


@contextlib.contextmanager
def start(
  task: str, contract: dict[str, Any] | None = None, **settings: Any
) -> Generator[Doubles]:
  """Starts the doubles and connects the drivers to them.

  Args:
    task: Name of the task, or path of its MJCF file.
    contract: That of the policy, see ``deploy.contract``; no cameras without.
    settings: See ``serve``.

  Raises:
    UserError: A package is missing, or a double cannot start.
  """
  with contextlib.ExitStack() as stack:
    server = serve(task, **settings)
    stack.callback(server.close)
    host, terminal = server.greeting
    arm = UR5e(host, payload_kg=PAYLOAD_KG, payload_cog_m=PAYLOAD_COG_M)
    arm.connect()
    stack.callback(arm.disconnect)
    gripper = connect(terminal)
    stack.callback(gripper.disconnect)
    yield Doubles(server, arm, gripper)


def serve(
  task: str,
  *,
  noise: bool = True,
  gripper: int = RNA.model_number,
  model_number: int | None = None,
  **controller: Any,
) -> Child:
  """Starts the doubles of arm and gripper; greets with address and serial port.

  Args:
    task: Name of the task, or path of its MJCF file.
    noise: Whether the force-torque sensor is noisy.
    gripper: Model number of the gripper.
    model_number: What it gives as its model number, if not that.
    controller: Arguments of ``controller.Controller``.
  """
  settings = {
    "scene": task,
    "host": _address(),
    "noise": noise,
    "gripper": gripper,
    "model_number": model_number,
    "controller": controller,
  }
  return Child("apnpql_jax.robot.doubles.server", settings)


def _address() -> str:
  """Returns a loopback address of this process's own, as the ports are fixed."""
  process, count = os.getpid(), next(_COUNT)
  return f"127.{process // 250 % 250 + 1}.{process % 250 + 1}.{count % 250 + 1}"
