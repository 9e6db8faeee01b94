"""The folder of a log: new for each session, and gone if no episode was played."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
from test_replayed_logs import CONTRACT

from apnpql_jax.errors import DeviceError, FileError, RunStopped
from apnpql_jax.robot import run
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.episodes import Options
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.recorder import Recorder

pytest.importorskip("pyarrow")

FAILURES = (
  (DeviceError("camera wrist: sent no frame for 5.0 s"), DeviceError),
  (RunStopped("SIGINT", 130), RunStopped),
)


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


def play(log: Path) -> None:
  policy = PolicyFolder(Path("policy"), CONTRACT)
  robot = Robot("double", CONTRACT, Cell())
  run.run(robot, policy, Options(log=str(log)), episodes=1)


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
