"""A check of everything that a run needs, without motion."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import devices, simulated
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.contact import FILTER_S, stiffness_limit
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.limits import MotionLimiter
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.supervisor import CAMERAS

_WAIT_S = 5.0
"""Time that a device may take for its first measurement."""


def check(
  robot: Robot, policy: PolicyFolder, *, admittance: bool = True
) -> dict[str, Any]:
  """Opens the devices and returns what they report, by line of the table.

  Raises:
    DeviceError: A device is missing, silent, or delivers something unexpected.
  """
  contract, model = robot.contract, ArmModel()
  lines: dict[str, Any] = {
    "policy": f"{policy.path}: {contract['task']}, every "
    f"{contract['control_period_s']} s for {contract['time_limit_s']} s",
    "cell": str(robot.cell.path or f"that of the {robot.kind} robot"),
    "calibration": str(robot.cell.calibration or "none needed"),
  }
  limiter = MotionLimiter(robot.cell.limits(contract), model.tool_position)
  with contextlib.ExitStack() as stack:
    robot = stack.enter_context(simulated.started(robot))
    arm, gripper = stack.enter_context(devices.open_arm(robot))
    state = arm.get_observation()
    age = robot.clock.now() - state.time
    if state.fault:
      raise DeviceError(f"arm: {state.fault}")
    lines["arm"] = f"{_text(arm.describe())}; measured {1e3 * age:.0f} ms ago"
    tool = ", ".join(f"{x:.3f}" for x in model.tool_position(state.position))
    outside = limiter.start(state.position)
    lines["tool"] = f"at ({tool}) m, " + (outside or "inside the workspace box")
    angle = gripper.get_observation().angle
    lines["gripper"] = f"{_text(gripper.describe())}; at {angle:.2f} rad"
    cameras = stack.enter_context(devices.open_cameras(robot))
    for camera in cameras:  # The first frame may take long.
      _first(camera)
    for name, camera in zip(CAMERAS, cameras, strict=True):
      frame, view = _first(camera), contract["cameras"][name]
      if frame.image.shape != (view["height"], view["width"], 3):
        raise DeviceError(
          f"camera {name}: an image of {frame.image.shape}, not {view['height']} x "
          f"{view['width']} pixels"
        )
      age = robot.clock.now() - frame.time
      lines[f"camera {name}"] = f"{_text(camera.describe())}; {1e3 * age:.0f} ms old"
  if admittance:
    lines["admittance"] = _contacts(model, policy, robot)
  else:
    lines["admittance"] = "off"
  return lines


def _contacts(model: ArmModel, policy: PolicyFolder, robot: Robot) -> str:
  """Returns which contacts stay stable, at the neutral pose."""
  admittance = robot.cell.admittance()
  dynamics = model.dynamics(policy.neutral, np.zeros(6))
  bears = min(
    stiffness_limit(
      dynamics, axis, admittance, admittance.lag - FILTER_S, saturated=True
    )
    for axis in np.eye(3)
  )
  return (
    f"damping of {admittance.damping:.0f} N s/m in contact; stable for walls of up to "
    f"{1e-3 * bears:.0f} kN/m at a lag of {1e3 * admittance.lag:.0f} ms"
  )


def _first(camera: Any) -> Any:
  """Returns a frame; cameras may need a while for the first one."""
  until = time.monotonic() + _WAIT_S
  while True:
    try:
      return camera.get_observation()
    except DeviceError:
      if time.monotonic() > until:
        raise
      time.sleep(0.1)


def _text(about: dict[str, Any]) -> str:
  """Returns model, serial number and versions in a line."""
  return ", ".join(str(x) for x in about.values() if isinstance(x, str | int))
