"""Sessions on the simulated robot that end early, also as processes are killed."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import signal
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from apnpql_jax.data import lerobot
from apnpql_jax.errors import DeviceError, RunStopped
from apnpql_jax.robot import policy_folder, policy_process, session
from apnpql_jax.robot.blackboard import Phase
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.episodes import Options
from apnpql_jax.robot.run import EVENTS, run
from apnpql_jax.robot.session import UNKNOWN, Session
from apnpql_jax.robot.simulated import devices as simulated
from apnpql_jax.robot.supervisor import Mode
from apnpql_jax.testing import export_untrained

CONTRACT: dict[str, Any] = {"task": "push_plate", "time_limit_s": 1.5}
POLICY = policy_folder.PolicyFolder(Path("policy"), CONTRACT)
ROBOT = Robot("simulated", CONTRACT, Cell(), Clock())


def test_an_episode_that_never_began_is_not_judged():
  """The control process refuses it, so the policy does not play."""
  session = Session(ROBOT, POLICY, Options())
  control: Any = SimpleNamespace(ended=[], events=list, is_alive=lambda _: False)
  session.processes = control
  refused = {"number": 1, "done": 1, "mode": Mode.STOP, "reason": b"free the hand"}
  session.board["state"].write(refused)
  outcome = session.play()
  assert (outcome.reason, outcome.actions) == ("free the hand", 0)
  assert outcome.solved is None
  session.processes = None
  session.close()


def test_a_signal_ends_the_start_of_the_plant():
  session = Session(ROBOT, POLICY, Options(), [signal.SIGTERM])
  with pytest.raises(RunStopped, match="SIGTERM") as stop, session:
    pass
  assert stop.value.code == 128 + signal.SIGTERM
  assert session.rest == "the arm has not moved"


def test_the_start_of_the_plant_takes_no_longer_than_it_may(monkeypatch):
  monkeypatch.setattr(simulated, "_START_S", 0.1)
  with (
    pytest.raises(DeviceError, match=r"simulated robot: it is not ready after 0.1 s"),
    simulated.started(ROBOT),
  ):
    pass


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Iterator[policy_folder.PolicyFolder]:
  folder = tmp_path_factory.mktemp("session") / "policy"
  export_untrained(folder, time_limit_s=30.0)
  yield policy_folder.load(folder)


def killed_in(
  phase: Phase,
  name: str,
  policy: policy_folder.PolicyFolder,
  log: Path,
  monkeypatch,
  *,
  number: int = signal.SIGKILL,
) -> dict[str, Any]:
  """Runs a session, one of whose processes gets a signal while its arm moves."""
  wait = Session.wait_until_ready

  def ready(session: Session) -> None:
    wait(session)
    threading.Thread(target=kill, args=(session,), daemon=True).start()

  def kill(session: Session) -> None:
    board, played = session.board, 3 if phase is Phase.PLAY else 0
    while board["state"].read()["phase"] != phase:
      time.sleep(0.01)
    while board["policy"].read()["actions"] < played:
      time.sleep(0.01)
    assert session.processes is not None
    session.processes.send_signal(name, number)

  monkeypatch.setattr(Session, "wait_until_ready", ready)
  robot = Robot("simulated", policy.contract, Cell(), Clock(8.0))
  return run(robot, policy, Options(log=str(log)), episodes=3)


@pytest.mark.slow
def test_a_process_that_ends_before_the_first_episode_is_no_bad_input(
  policy, tmp_path, monkeypatch, capsys
):
  pytest.importorskip("pyarrow")
  found = killed_in(Phase.HOME, "policy", policy, tmp_path / "log", monkeypatch)
  assert (found["exit_code"], found["episodes"]) == (3, 0)
  assert "policy" in found["failure"] and "process has ended" in found["failure"]
  assert found["arm"] == "the arm is at rest"
  assert "the session ends after 0 of 3 episodes: " in capsys.readouterr().err
  assert not (tmp_path / "log").exists() and "log" not in found


@pytest.mark.slow
@pytest.mark.parametrize(
  ("name", "rest"), [("control", UNKNOWN), ("policy", "the arm is at rest")]
)
def test_the_end_of_a_process_leaves_the_log_and_code_3(
  policy, tmp_path, monkeypatch, capsys, name, rest
):
  pytest.importorskip("pyarrow")
  log = tmp_path / "log"
  found = killed_in(Phase.PLAY, name, policy, log, monkeypatch)
  assert found["exit_code"] == 3 and found["episodes"] == 1
  assert found["arm"] == rest and rest in capsys.readouterr().err
  (line,) = (log / EVENTS).read_text().splitlines()
  kept = json.loads(line)
  assert "process has ended" in kept["reason"] == found["reasons"][0]
  assert kept["actions"] >= 3 and kept["solved"] is None
  episodes = lerobot.read(log).episodes
  if name == "policy":  # It took its episode along.
    assert (kept["dataset_index"], episodes) == (None, [])
  else:
    assert kept["dataset_index"] == 0
    assert len(episodes[0].actions) == kept["actions"]


@pytest.mark.slow
def test_a_policy_that_hangs_ends_the_session_with_the_arm_at_rest(
  policy, tmp_path, monkeypatch
):
  pytest.importorskip("pyarrow")
  monkeypatch.setattr(policy_process, "END_S", 3.0)
  log = tmp_path / "log"
  stop = {"number": signal.SIGSTOP}
  found = killed_in(Phase.PLAY, "policy", policy, log, monkeypatch, **stop)
  assert (found["exit_code"], found["episodes"]) == (3, 1)
  assert found["failure"] == "policy: it does not end its episode"
  assert found["reasons"] == ["policy: two periods late"]
  assert found["arm"] == "the arm is at rest"
  kept = json.loads((log / EVENTS).read_text())
  assert kept["dataset_index"] is None and kept["solved"] is None


@pytest.mark.slow
def test_a_control_that_hangs_ends_the_session_with_an_unknown_arm(
  policy, tmp_path, monkeypatch
):
  """The policy plays on until its time is over; nobody commands the arm."""
  pytest.importorskip("pyarrow")
  monkeypatch.setattr(session, "REST_S", 1.0)
  log = tmp_path / "log"
  short = policy_folder.PolicyFolder(policy.path, policy.contract | CONTRACT)
  stop = {"number": signal.SIGSTOP}
  found = killed_in(Phase.PLAY, "control", short, log, monkeypatch, **stop)
  assert (found["exit_code"], found["episodes"]) == (3, 1)
  assert found["failure"] == "robot: the arm does not come to rest"
  assert found["arm"] == UNKNOWN
  assert json.loads((log / EVENTS).read_text())["solved"] is None
  (kept,) = lerobot.read(log).episodes
  assert len(kept.actions) > 3
