"""A check of everything that a run needs. It only reads: nothing moves.

Each row of its table is about one thing, and is there whether or not others fail.
"""

from __future__ import annotations

import contextlib
from typing import Any

from apnpql_jax.robot import policy_process, priority, setup
from apnpql_jax.robot.check import devices, program
from apnpql_jax.robot.check.table import Table
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.simulated.devices import started


def check(
  robot: Robot, policy: PolicyFolder, *, admittance: bool = True
) -> dict[str, Any]:
  """Reads the devices, tries the program, and returns what is found, by row.

  Raises:
    DeviceError: A simulated robot does not start.
  """
  contract, table, loaded = robot.contract, Table(), False
  table.rows = {
    "policy": f"{policy.path}: {contract['task']}, every "
    f"{contract['control_period_s']} s for {contract['time_limit_s']} s",
    "cell": str(robot.cell.path or f"that of the {robot.kind} robot"),
    "calibration": str(robot.cell.calibration or "none needed"),
  }
  if robot.kind == "ur5e":
    table.rows["priority"] = _priority()
  with table.row("calibration"):
    setup.check_calibration(robot)
  act = program.rest
  with table.row("program"):  # First, because simulated cameras need JAX set up.
    act, loaded = policy_process.load_program(policy, seed=0), True
  with contextlib.ExitStack() as stack:
    robot = stack.enter_context(started(robot))
    senses = program.Senses(
      devices.arm(stack, table, robot, policy.neutral),
      devices.gripper(stack, table, robot),
      devices.cameras(stack, table, robot),
    )
    with table.row("program"):
      seconds, ages = program.try_out(act, robot, senses)
      if loaded:
        program.report(table, robot, seconds)
      devices.ages(table, robot, ages)
  table.rows["admittance"] = _contacts(robot) if admittance else "off"
  return table.result()


def _priority() -> str:
  if priority.is_granted():
    return "real-time, of the control process"
  return "not real-time: set a limit rtprio, see docs/robot_first_run.md"


def _contacts(robot: Robot) -> str:
  """Returns which contacts stay stable: those of less than D_c / tau."""
  admittance = robot.cell.admittance()
  bears = admittance.damping / admittance.lag
  return (
    f"damping of {admittance.damping:.0f} N s/m in contact; stable for walls of up to "
    f"{1e-3 * bears:.0f} kN/m at a lag of {1e3 * admittance.lag:.0f} ms"
  )
