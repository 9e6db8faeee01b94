"""Episodes of a policy on a robot."""

from __future__ import annotations

from collections.abc import Generator, Sequence
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import shutil
import signal
from typing import Any

import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.console import print_line
from apnpql_jax.data import lerobot
from apnpql_jax.errors import (
  FAILED,
  DeviceError,
  FileError,
  RunStopped,
  UserError,
  one_line,
)
from apnpql_jax.robot import replay
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.episodes import Homing, Options, Outcome
from apnpql_jax.robot.interrupts import INTERRUPTS
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.session import Session
from apnpql_jax.robot.supervisor import NO_ACTION
from apnpql_jax.runs.success import success_figures

EVENTS = "episodes.jsonl"
"""File in the folder of a log: an episode per line, with each change of the mode."""


def run(
  robot: Robot, policy: PolicyFolder, options: Options, *, episodes: int
) -> dict[str, Any]:
  """Plays episodes, each from the neutral pose, and prints a line about each.

  The arm also goes home after the last one, where its force sensor is checked. A fault
  ends its episode, and the next one begins, unless the arm cannot go home. On a ur5e it
  also ends the session.

  Returns:
    Counts, reasons, and the success rate if a simulated robot can judge it. If the
    session ends before its last episode, also ``failure`` and ``exit_code``.

  Raises:
    ConfigError: A package is missing.
    FileError: The log exists, or the log to replay is not a log or does not fit the
      policy.
    DeviceError: A device or process has failed before the arm moved.
    RunStopped: One of ``INTERRUPTS`` came; with what is known about the arm.
  """
  if options.replay is not None:
    replay.recorded_actions(Path(options.replay), policy.contract)
  outcomes: list[Outcome] = []
  with _new_log(options.log, outcomes), catching_signals() as caught:
    session = Session(robot, policy, options, caught)
    try:
      with session:
        session.wait_until_ready()
        failure = _play(session, robot, options, outcomes, episodes)
    except RunStopped as stop:
      raise RunStopped(f"{stop}: {session.rest}", stop.code) from None
  if failure:
    count = f"{len(outcomes)} of {episodes} episodes"
    print_line(f"the session ends after {count}: {failure}; {session.rest}")
  return _summary(robot, options, outcomes, failure) | {"arm": session.rest}


def _play(
  session: Session,
  robot: Robot,
  options: Options,
  outcomes: list[Outcome],
  episodes: int,
) -> str:
  """Adds an outcome for each episode; returns what has ended the session early.

  The arm has moved by then, so a failure no longer counts as bad input.
  """
  try:
    _go_home(session)
    for episode in range(episodes):
      outcomes.append(session.play())
      _report(episode, episodes, outcomes[-1])
      _keep(options.log, outcomes)
      session.check()
      if robot.kind == "ur5e" and outcomes[-1].stopped:
        # It may press on something, and would move home next.
        raise DeviceError("look at the arm after a stop, then start again")
      try:
        _go_home(session)
      finally:
        outcomes[-1] = dataclasses.replace(outcomes[-1], homing_after=session.homing)
        _keep(options.log, outcomes)
  except (UserError, OSError) as error:
    return one_line(error)
  return ""


def _go_home(session: Session) -> None:
  try:
    session.go_home()
  finally:
    if reason := session.homing.reset_reason:
      print_line(f"the simulated robot was reset: {reason}")


@contextlib.contextmanager
def _new_log(folder: str | None, outcomes: Sequence[Outcome]) -> Generator[None]:
  """Makes the folder of a log; removes it if no episode is played, for another try."""
  if folder is None:
    yield
    return
  lerobot.check_available()
  try:
    Path(folder).mkdir(parents=True)
  except FileExistsError:
    raise FileError(f"{folder!r} exists; name another folder with --log") from None
  try:
    yield
  finally:
    if not outcomes:
      shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def catching_signals() -> Generator[list[int]]:
  """Yields a list that gets signals which would end or suspend the main process.

  A session ends at the first one, with the arm at rest.
  """
  caught: list[int] = []

  def note(number: int, _: object) -> None:
    caught.append(number)
    if number == signal.SIGTSTP:  # Others of the pipeline are suspended now.
      os.killpg(0, signal.SIGCONT)

  wake = signal.set_wakeup_fd(-1)  # Of ``runs.signals``, which would end at once.
  before = {number: signal.signal(number, note) for number in INTERRUPTS}
  try:
    yield caught
  finally:
    for number, handler in before.items():
      signal.signal(number, handler)
    signal.set_wakeup_fd(wake)


def _report(episode: int, episodes: int, outcome: Outcome) -> None:
  holds = sum(
    mode == "hold" and reason != NO_ACTION for _, mode, reason in outcome.events
  )
  counts = {"missed periods": outcome.missed_periods, "late cycles": outcome.overruns}
  late = "".join(f", {name}: {n}" for name, n in counts.items() if n)
  print_line(
    f"episode {episode + 1} of {episodes}: {outcome.reason}, {outcome.seconds:.1f} s, "
    f"{outcome.actions} actions, {holds} holds{late}"
  )


def _keep(log: str | None, outcomes: Sequence[Outcome]) -> None:
  """Writes the lines of all episodes; the last one may have become longer."""
  if log is None:
    return
  with replacing(Path(log) / EVENTS) as part:
    lines = [json.dumps(dataclasses.asdict(x)) + "\n" for x in outcomes]
    part.write_text("".join(lines), encoding="utf-8")


def _summary(
  robot: Robot, options: Options, outcomes: list[Outcome], failure: str
) -> dict[str, Any]:
  found: dict[str, Any] = {
    "robot": robot.kind,
    "task": robot.contract["task"],
    "episodes": len(outcomes),
    "reasons": [x.reason for x in outcomes],
    "actions": sum(x.actions for x in outcomes),
    "seconds": sum(x.seconds for x in outcomes),
    "missed_periods": sum(x.missed_periods for x in outcomes),
    "overruns": sum(x.overruns for x in outcomes),
  }
  judged = [x.solved for x in outcomes if x.solved is not None]
  if judged:
    found |= success_figures(sum(judged), len(judged))
  found |= _at_home([x.homing_after for x in outcomes if x.homing_after is not None])
  if options.log is not None and outcomes:
    found["log"] = options.log
  if failure:
    found |= {"failure": failure, "exit_code": FAILED}
  return found


def _at_home(ways: Sequence[Homing]) -> dict[str, Any]:
  """Returns what the homings after episodes have shown.

  ``zero_error_n`` and ``zero_error_nm`` are the largest force and torque that the hand
  read there, ``resets`` how often a simulated robot was reset.
  """
  found: dict[str, Any] = {}
  if read := [x.unloaded_wrench for x in ways if x.unloaded_wrench is not None]:
    norms = np.linalg.norm(np.reshape(read, (-1, 2, 3)), axis=2).max(0)
    found["zero_error_n"], found["zero_error_nm"] = norms.tolist()
  if resets := sum(x.reset_reason is not None for x in ways):
    found["resets"] = resets
  return found
