"""The devices of a robot, opened where they are used.

Drivers are imported in the functions, because each needs packages of its vendor.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
import contextlib
import importlib
from typing import Any

from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.protocols import CAMERAS, Arm, Camera, Device, Gripper, Judge


def make_arm(robot: Robot, *, reads: bool = False) -> Any:
  """Returns the arm, not connected; with ``reads``, one that takes no commands."""
  if robot.kind == "simulated":
    simulated = importlib.import_module("apnpql_jax.robot.simulated.devices")
    return simulated.SimulatedArm(robot.plant)
  cell = robot.cell
  if reads:
    listener = importlib.import_module("apnpql_jax.robot.drivers.ur_listener")
    return listener.Inspector(cell.arm_host)
  ur5e = importlib.import_module("apnpql_jax.robot.drivers.ur5e")
  return ur5e.UR5e(
    cell.arm_host, payload_kg=cell.payload_kg, payload_cog_m=cell.payload_cog_m
  )


def make_gripper(robot: Robot) -> Gripper:
  """Returns the gripper, not connected."""
  if robot.kind == "simulated":
    simulated = importlib.import_module("apnpql_jax.robot.simulated.devices")
    return simulated.SimulatedGripper(robot.plant)
  grippers = importlib.import_module("apnpql_jax.robot.drivers.gripper")
  return grippers.RHP12RN(robot.cell.gripper_port)


@contextlib.contextmanager
def open_arm(robot: Robot) -> Generator[tuple[Arm, Gripper]]:
  """Connects arm and gripper; nothing moves.

  Raises:
    DeviceError: A device is missing, silent or another one, or a package is missing.
  """
  with contextlib.ExitStack() as stack:
    arm, gripper = make_arm(robot), make_gripper(robot)
    for device in (arm, gripper):
      stack.enter_context(connected(device))
    yield arm, gripper


@contextlib.contextmanager
def connected(device: Device) -> Generator[None]:
  """Connects a device and disconnects it at the end."""
  device.connect()
  try:
    yield
  finally:
    device.disconnect()


@contextlib.contextmanager
def open_cameras(robot: Robot) -> Generator[tuple[Sequence[Camera], Judge | None]]:
  """Connects the cameras, in the order of ``protocols.CAMERAS``; see ``open_arm``.

  With them comes what judges their scene, if something can.
  """
  judge: Judge | None = None
  with contextlib.ExitStack() as stack:
    views = robot.contract["cameras"]
    if robot.kind == "simulated":
      rendered = importlib.import_module("apnpql_jax.robot.simulated.cameras")
      cameras: Sequence[Camera]
      cameras, judge = rendered.make(robot.plant, robot.contract)
    elif robot.kind == "double":
      doubles = importlib.import_module("apnpql_jax.robot.doubles.cameras")
      eyes = doubles.cameras(
        robot.cell.arm_host, robot.contract["task"], robot.contract
      )
      by_name = stack.enter_context(eyes)
      cameras = [by_name[name] for name in CAMERAS]
    else:
      realsense = importlib.import_module("apnpql_jax.robot.drivers.realsense")
      serials, modes = robot.cell.cameras, calibrated_modes(robot)
      cameras = [
        realsense.RealSense(serials[x], view=views[x], **modes.get(x, {}))
        for x in CAMERAS
      ]
    for camera in cameras:
      stack.enter_context(connected(camera))
    yield cameras, judge


def calibrated_modes(robot: Robot) -> dict[str, Any]:
  """Returns lens and image size of each camera whose lens the calibration estimated.

  The other cameras have the maker's lens, in whichever mode.

  Raises:
    FileError: The calibration is damaged or of other cameras.
    ConfigError: A camera is not where the policy was trained for.
  """
  cell = robot.cell
  if cell.calibration is None or not cell.calibration.exists():
    return {}
  files: Any = importlib.import_module("apnpql_jax.robot.calibration.files")
  found = files.load(cell.calibration, robot.contract, cell.cameras)
  return {
    name: {
      "lens": camera.lens.to_json(),
      "size": (camera.lens.height, camera.lens.width),
    }
    for name, camera in found.cameras.items()
    if camera.about.get("lens_from") == "views"
  }
