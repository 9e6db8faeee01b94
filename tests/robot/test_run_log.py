"""The folder of a log: new for each session, gone if no episode was played.

And what its lines say about the ways home.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import pytest
from test_replayed_logs import CONTRACT

from apnpql_jax.errors import DeviceError, FileError, RunStopped
from apnpql_jax.robot import run
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.episodes import Homing, Options, Outcome
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.recorder import Recorder

pytest.importorskip("pyarrow")

FAILURES = (
  (DeviceError("camera wrist: sent no frame for 5.0 s"), DeviceError),
  (RunStopped("SIGINT", 130), RunStopped),
)


FREE = [1.0, 0.0, 0.0, 0.0, 0.0, 0.1]
PRESSED = [0.0, 0.0, -14.0, 0.0, 0.0, 0.2]


class Failing(contextlib.nullcontext):
  """A session that ends after the policy process has begun its log."""

  error: Exception
  rest = "the arm has not moved"

  def __init__(self, robot: Robot, policy: Any, options: Options, signals: Any):
    super().__init__()
    assert options.log is not None
    self._folder, self._contract = Path(options.log), robot.contract

  def wait_until_ready(self) -> None:
    with Recorder(self._folder, self._contract, judged=False):
      assert list(self._folder.iterdir())
      raise self.error


def play(log: Path, episodes: int = 1) -> dict[str, Any]:
  policy = PolicyFolder(Path("policy"), CONTRACT)
  robot = Robot("double", CONTRACT, Cell())
  return run.run(robot, policy, Options(log=str(log)), episodes=episodes)


@pytest.mark.parametrize(("error", "kind"), FAILURES)
def test_a_session_without_episodes_leaves_no_log(tmp_path, monkeypatch, error, kind):
  monkeypatch.setattr(run, "Session", Failing)
  monkeypatch.setattr(Failing, "error", error, raising=False)
  for _ in range(2):  # The same command can be tried again.
    with pytest.raises(kind, match=str(error)):
      play(tmp_path / "logs" / "first")
  assert not (tmp_path / "logs" / "first").exists()


def test_a_folder_that_exists_is_left_alone(tmp_path):
  (tmp_path / "mine").write_text("")
  with pytest.raises(FileError, match="exists; name another folder with --log"):
    play(tmp_path)
  assert (tmp_path / "mine").exists()


class Drifting(contextlib.nullcontext):
  """A session whose second way home needs help, and whose third one shows drift."""

  rest = "the arm is at rest"

  def __init__(self, robot: Robot, policy: Any, options: Options, signals: Any):
    super().__init__()
    del robot, policy, options, signals
    self.homing = Homing()
    self._ways = iter([Homing(FREE), Homing(FREE, "gripper: still"), Homing(PRESSED)])

  def __enter__(self) -> Drifting:
    return self

  def wait_until_ready(self) -> None: ...

  def check(self) -> None: ...

  def go_home(self) -> None:
    self.homing = next(self._ways)
    if self.homing.unloaded_wrench == PRESSED:
      raise DeviceError("the arm is not home: the arm reads 14 N")

  def play(self) -> Outcome:
    return Outcome(None, "time limit", 5, 1.0, [], homing_before=self.homing)


def test_each_line_has_what_both_ways_home_have_shown(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr(run, "Session", Drifting)
  found = play(tmp_path / "log", episodes=4)
  lines = (tmp_path / "log" / run.EVENTS).read_text().splitlines()
  first, second = (json.loads(line) for line in lines)
  free = {"unloaded_wrench": FREE, "reset_reason": None}
  freed = {"unloaded_wrench": FREE, "reset_reason": "gripper: still"}
  assert (first["homing_before"], first["homing_after"]) == (free, freed)
  assert second["homing_before"] == freed
  assert second["homing_after"] == free | {"unloaded_wrench": PRESSED}
  assert (found["zero_error_n"], found["zero_error_nm"]) == (14.0, 0.2)
  assert (found["resets"], found["exit_code"], found["episodes"]) == (1, 3, 2)
  shown = capsys.readouterr().err
  assert "the simulated robot was reset: gripper: still" in shown
  assert "ends after 2 of 4 episodes: the arm is not home: the arm reads 14 N" in shown


def test_the_arm_goes_home_after_the_last_episode(tmp_path, monkeypatch):
  monkeypatch.setattr(run, "Session", Drifting)
  found = play(tmp_path / "log", episodes=1)
  (line,) = (tmp_path / "log" / run.EVENTS).read_text().splitlines()
  assert json.loads(line)["homing_after"]["unloaded_wrench"] == FREE
  assert "failure" not in found and found["episodes"] == 1
