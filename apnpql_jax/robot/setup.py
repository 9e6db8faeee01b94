"""The robot that a command is about, checked before anything is opened or moves."""

from __future__ import annotations

from collections.abc import Generator
import contextlib
import dataclasses
import importlib
from pathlib import Path

from apnpql_jax.errors import ConfigError
from apnpql_jax.robot import devices
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.cell import Cell, load_cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.limits import MotionLimiter
from apnpql_jax.robot.policy_folder import PolicyFolder


def check_task(policy: PolicyFolder, task: str) -> None:
  """Raises ``ConfigError`` if a policy is for another task than that of the table."""
  own = policy.contract["task"]
  if task and task != own:
    raise ConfigError(f"the policy in {policy.path} is for {own}, not for {task}")


def describe(
  kind: str,
  policy: PolicyFolder,
  path: Path,
  *,
  slowdown: float = 1.0,
  calibrated: bool = True,
) -> Robot:
  """Returns the robot of a command.

  Args:
    kind: One of ``description.ROBOTS``.
    policy: The policy to run.
    path: File of the cell, for a real arm.
    slowdown: That of a simulated robot's clock.
    calibrated: Whether a real arm must have its calibration.

  Raises:
    ConfigError: The cell is invalid, has no calibration or that of other cameras, or
      does not contain the neutral pose; or the scene of the task has changed.
  """
  cell = load_cell(path) if kind == "ur5e" else Cell()
  robot = Robot(kind, policy.contract, cell, Clock(slowdown))
  limits, model = cell.limits(policy.contract), ArmModel()
  outside = MotionLimiter(limits, model.tool_position).outside(policy.neutral)
  if outside:
    raise ConfigError(f"{path}: in the neutral pose of the policy {outside}")
  _check_scene(policy)
  if calibrated:
    check_calibration(robot)
  return robot


@contextlib.contextmanager
def doubled(robot: Robot) -> Generator[Robot]:
  """Starts the servers of a double, and yields the robot to open; others as given."""
  if robot.kind != "double":
    yield robot
    return
  with contextlib.ExitStack() as stack:
    doubles = importlib.import_module("apnpql_jax.robot.doubles")
    server = doubles.serve(robot.contract["task"])
    stack.callback(server.close)
    host, port = server.greeting
    cell = dataclasses.replace(robot.cell, arm_host=host, gripper_port=port)
    yield dataclasses.replace(robot, cell=cell)


def _check_scene(policy: PolicyFolder) -> None:
  """Checks that the scene of the task is that of the training."""
  from apnpql_jax.tasks import make_task

  task, origin = policy.contract["task"], policy.contract.get("origin") or {}
  if make_task(task).scene.fingerprint != origin.get("scene_sha256"):
    raise ConfigError(
      f"the policy in {policy.path} was trained in another scene of {task}; use the "
      "version of apnpql that trained it"
    )


def check_calibration(robot: Robot) -> None:
  """Checks the calibration of a real arm.

  Raises:
    ConfigError: There is none, or a camera is not where the policy was trained for.
    FileError: It is damaged or of other cameras.
  """
  if robot.kind != "ur5e":
    return
  path = robot.cell.calibration
  if path is None or not path.is_file():
    raise ConfigError(f"{path} does not exist; make it with apnpql robot calibrate")
  devices.calibrated_modes(robot)
