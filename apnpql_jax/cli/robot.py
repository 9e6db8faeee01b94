"""The command ``apnpql robot``."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
import sys
from typing import Annotated, Any

import tyro

from apnpql_jax.cli.options import Command, File, Flag, default_hint
from apnpql_jax.errors import ConfigError, check_name

AsDefault = Annotated[str | None, default_hint("")]
ACTIONS = ("check", "calibrate", "run")

_OPTIONS = {
  "calibrate": ("views", "recorded", "board", "print_board", "board_on", "overwrite"),
  "run": ("episodes", "seed", "log", "replay", "latency_ms", "yes"),
}
"""Options that only one action takes."""


@dataclasses.dataclass(frozen=True)
class Robot(Command):
  """Runs an exported policy on an arm: apnpql robot ACTION [options].

  ACTION is check (only reads), calibrate (cameras) or run (plays episodes).

  apnpql robot check --robot ur5e --policy policy --cell robot.toml

  apnpql robot run --robot simulated --policy policy --episodes 20
  """

  action: tyro.conf.Positional[str] = ""
  """check, calibrate or run."""

  robot: str = "simulated"
  """ur5e; simulated: a MuJoCo plant behind the same runtime; double: servers that speak
  the protocols of the devices."""

  policy: File = None
  """Folder of an exported policy, see `apnpql export`."""

  cell: Annotated[Path, default_hint("(default: robot.toml)")] = Path("robot.toml")
  """File that describes the robot cell; used by ur5e only."""

  task: str = ""
  """Task set up on the table; policies for other tasks are refused."""

  episodes: int = 10
  """Number of episodes."""

  seed: int = 0
  """Random seed of the policy and of simulated reset states."""

  log: File = None
  """Folder to create for the log, a LeRobot dataset of what happened."""

  replay: File = None
  """Repeat the actions of a log instead of those of the policy."""

  admittance: bool = True
  """Give way to contacts."""

  latency_ms: float = 0.0
  """Delay of commands to a simulated arm."""

  slowdown: float = 1.0
  """Real seconds per simulated second; raise it on a busy machine."""

  yes: Flag = False
  """Move a real arm without asking."""

  views: Annotated[Path, default_hint("(default: views)")] = Path("views")
  """For calibrate: folder to write the views of the board to or, with --recorded, to
  read them from."""

  recorded: Flag = False
  """Calibrate from the views that are in the folder, without devices."""

  board: AsDefault = None
  """The printed board, for calibrate, such as 11x8:33.5:25:6x6_250."""

  print_board: File = None
  """Write the board as .pdf or .png to print it, for calibrate."""

  board_on: str = "tool"
  """Where the board is in views of the global camera: tool or table."""

  overwrite: Flag = False
  """Replace the calibration that exists."""


def robot(args: Robot) -> dict[str, Any]:
  """Checks, calibrates or runs a robot and returns the result."""
  if not args.action:
    raise ConfigError(f"robot needs an action: {', '.join(ACTIONS)}")
  check_name("robot action", args.action, ACTIONS)

  from apnpql_jax.robot import description

  check_name("--robot", args.robot, description.ROBOTS)
  _check_options(args)
  if args.print_board is not None:
    from apnpql_jax.robot.calibration import boards

    board = boards.Board() if args.board is None else boards.parse(args.board)
    return boards.print_board(board, args.print_board)
  if args.policy is None:
    raise ConfigError("robot needs --policy, the folder of an exported policy")

  from apnpql_jax.robot import policy_folder, setup

  policy = policy_folder.load(args.policy)
  setup.check_task(policy, args.task)
  opened = setup.describe(
    args.robot,
    policy,
    args.cell,
    slowdown=args.slowdown,
    calibrated=args.action == "run",
  )
  if args.action == "calibrate":
    return _calibrate(args, opened)
  with setup.doubled(opened) as opened:
    if args.action == "check":
      from apnpql_jax.robot.check.command import check

      return check(opened, policy, admittance=args.admittance)
    return _run(args, opened, policy)


def _run(args: Robot, opened: Any, policy: Any) -> dict[str, Any]:
  from apnpql_jax.robot.episodes import Options
  from apnpql_jax.robot.run import run

  if args.robot == "ur5e" and not args.yes:
    _confirm(args)
  return run(
    opened,
    policy,
    Options(
      seed=args.seed,
      admittance=args.admittance,
      latency_s=args.latency_ms / 1e3,
      log=None if args.log is None else str(args.log.absolute()),
      replay=None if args.replay is None else str(args.replay.absolute()),
    ),
    episodes=args.episodes,
  )


def _calibrate(args: Robot, opened: Any) -> dict[str, Any]:
  """Calibrates the cameras of a cell; the arm only moves by hand."""
  if (out := opened.cell.calibration) is None:
    raise ConfigError("only the cameras of --robot ur5e need a calibration")
  from apnpql_jax.robot.calibration import boards, live
  from apnpql_jax.robot.calibration.command import calibrate

  contract, serials = opened.contract, opened.cell.cameras
  devices = contextlib.nullcontext((None, None))
  if not args.recorded:
    devices = live.opened(contract, opened.cell.arm_host, serials)
  with devices as (arm, cameras):
    return calibrate(
      contract,
      args.views,
      out,
      board=boards.Board().text if args.board is None else args.board,
      board_on=args.board_on,
      arm=arm,
      cameras=cameras,
      serials=serials,
      overwrite=args.overwrite,
    )


def _check_options(args: Robot) -> None:
  """Raises ``ConfigError`` for values that no robot takes, or another action does."""
  defaults = Robot()
  for action, names in _OPTIONS.items():
    for name in names:
      if action != args.action and getattr(args, name) != getattr(defaults, name):
        raise ConfigError(f"--{name.replace('_', '-')} is for robot {action}")
  if args.episodes < 1 or not 0 <= args.seed < 2**32:
    raise ConfigError("--episodes must be at least 1 and --seed from 0 to 2^32 - 1")
  if not 0 <= args.latency_ms <= 500 or not 0.1 <= args.slowdown <= 100:
    raise ConfigError("--latency-ms must be 0 to 500 and --slowdown 0.1 to 100")
  if args.robot != "simulated" and (args.latency_ms, args.slowdown) != (0.0, 1.0):
    raise ConfigError("--latency-ms and --slowdown need --robot simulated")


def _confirm(args: Robot) -> None:
  """Asks before a real arm moves.

  Raises:
    ConfigError: The answer is no, or nobody can answer.
  """
  if not sys.stdin or not sys.stdin.isatty():
    raise ConfigError("a real arm would move; add --yes to skip the question")
  sys.stderr.write(
    f"The arm of {args.cell} will move. Keep the emergency stop at hand. Go on? [y/N] "
  )
  sys.stderr.flush()
  if sys.stdin.readline().strip().lower() not in ("y", "yes"):
    raise ConfigError("nothing has moved")
