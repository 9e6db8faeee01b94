"""The rows of a check about devices, which are only read.

Each function connects a device for as long as the stack is open, and returns what reads
it, or a stand-in for one that does not work.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot import devices
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.check.table import Table
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.limits import TIMESTEP, Limits, MotionLimiter
from apnpql_jax.robot.protocols import CAMERAS, ArmState, Frame

_WAIT_S = 5.0
"""Time that a camera may take for its first frame."""

_WATCH_S = 1.0
"""Time for which a device is watched: one measurement that is too old ends a run."""

Stack = contextlib.ExitStack


def arm(
  stack: Stack, table: Table, robot: Robot, neutral: np.ndarray
) -> Callable[[], np.ndarray]:
  """Adds the rows of the arm; returns what gives joint angles f64[6], rad."""
  limits, model = robot.cell.limits(robot.contract), ArmModel()
  with table.row("arm"):
    device = devices.make_arm(robot, reads=True)
    stack.enter_context(devices.connected(device))
    state, age = _watch(robot, device)
    table.rows["arm"] = f"{_text(device)}; measured up to {1e3 * age:.0f} ms ago"
    for problem in _problems(device, state, age, limits):
      table.fail("arm", problem)
    force = ", ".join(f"{x:.1f}" for x in model.base_mat @ state.wrench[:3])
    tool = ", ".join(f"{x:.3f}" for x in model.tool_position(state.position))
    table.rows["force"] = f"({force}) N in the world, before it is zeroed"
    table.rows["tool"] = f"at ({tool}) m, inside the workspace box"
    limiter = MotionLimiter(limits, model.tool_position)
    if outside := limiter.start(state.position):
      table.fail("tool", f"{outside}: move the arm by hand")
    elif obstruction := limiter.obstruction(neutral):
      table.fail("tool", obstruction)
    return table.guarded("arm", lambda: device.get_observation().position, neutral)
  return lambda: neutral


def gripper(stack: Stack, table: Table, robot: Robot) -> Callable[[], float]:
  """Adds the row of the gripper; returns what gives the finger's angle, rad."""
  with table.row("gripper"):
    device = devices.make_gripper(robot)
    stack.enter_context(devices.connected(device))
    state, age = _watch(robot, device)
    angle, most = state.angle, robot.cell.limits(robot.contract).gripper_age
    measured = f"measured up to {1e3 * age:.0f} ms ago"
    table.rows["gripper"] = f"{_text(device)}; at {angle:.2f} rad, {measured}"
    if age > most:
      table.fail("gripper", f"it was {measured}, the limit is {1e3 * most:.0f} ms")
    return table.guarded("gripper", lambda: device.get_observation().angle, angle)
  return lambda: 0.0


def cameras(stack: Stack, table: Table, robot: Robot) -> Callable[[], Sequence[Frame]]:
  """Adds a row for each camera; returns what gives a frame of each.

  If the calibration fails, the cameras have the maker's lenses.
  """
  dark = _dark(robot)
  if "calibration" in table.failing:
    cell = dataclasses.replace(robot.cell, calibration=None)
    robot = dataclasses.replace(robot, cell=cell)
  with table.row("cameras"):
    opened, _ = stack.enter_context(devices.open_cameras(robot))
    for name, camera in zip(CAMERAS, opened, strict=True):
      view, shape = robot.contract["cameras"][name], _first_frame(camera).image.shape
      if shape != (view["height"], view["width"], 3):
        raise DeviceError(
          f"camera {name}: an image of {shape}, not {view['height']} x "
          f"{view['width']} pixels"
        )
      table.rows[f"camera {name}"] = _text(camera)
    return table.guarded("cameras", lambda: [x.get_observation() for x in opened], dark)
  return lambda: dark


def ages(table: Table, robot: Robot, found: np.ndarray) -> None:
  """Adds the greatest ages of the frames, f64[2], s, to the rows of the cameras."""
  if "cameras" in table.failing:
    return
  most = robot.cell.limits(robot.contract).frame_age
  for name, age in zip(CAMERAS, found, strict=True):
    row, text = f"camera {name}", f"frames of up to {1e3 * age:.0f} ms when it acts"
    if age > most:
      table.fail(row, f"{text}, the limit is {1e3 * most:.0f} ms")
    else:
      table.rows[row] += f"; {text}"


def _dark(robot: Robot) -> Sequence[Frame]:
  """Returns black frames."""
  views, now = robot.contract["cameras"], robot.clock.now()
  sizes = [(views[name]["height"], views[name]["width"], 3) for name in CAMERAS]
  return [Frame(now, np.zeros(size, np.uint8)) for size in sizes]


def _watch(robot: Robot, device: Any) -> tuple[Any, float]:
  """Watches arm or gripper; returns the last state and the greatest age, s."""
  clock, oldest = robot.clock, 0.0
  end = clock.now() + _WATCH_S
  while True:
    state, now = device.get_observation(), clock.now()
    oldest = max(oldest, now - state.time)
    if now >= end:
      return state, oldest
    clock.sleep(TIMESTEP)


def _problems(device: Any, state: ArmState, age: float, limits: Limits) -> list[str]:
  """Returns what keeps the arm from following."""
  found = [state.fault] if state.fault else []
  found += getattr(device, "problems", list)()  # Simulated arms have none.
  if age > limits.joint_age:
    found.append(
      f"its joints were measured up to {1e3 * age:.0f} ms ago, the limit is "
      f"{1e3 * limits.joint_age:.0f} ms: check the network"
    )
  return found


def _first_frame(camera: Any) -> Frame:
  """Returns a frame; cameras may need a while for the first one."""
  until = time.monotonic() + _WAIT_S
  while True:
    try:
      return camera.get_observation()
    except DeviceError:
      if time.monotonic() > until:
        raise
      time.sleep(0.1)


def _text(device: Any) -> str:
  """Returns model, serial number and versions in a line."""
  about = device.describe()
  shown = {key: x for key, x in about.items() if isinstance(x, str | int)}
  plain = "model", "bus"
  return ", ".join(
    str(x) if key in plain else f"{key.replace('_', ' ')} {x}"
    for key, x in shown.items()
  )
