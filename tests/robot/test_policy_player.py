"""The policy's side of an episode: its periods, and its log whatever ends it.

A clock that advances when the player waits, or the policy thinks, makes it exact.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rigs import START, TurnedClock

from apnpql_jax.data import lerobot
from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.blackboard import Blackboard, Phase
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.player import Player, next_period
from apnpql_jax.robot.protocols import Frame
from apnpql_jax.robot.recorder import Recorder

PERIOD = 0.15
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
CONTRACT: dict[str, Any] = {
  "task": "push_plate",
  "control_period_s": PERIOD,
  "time_limit_s": 10 * PERIOD,
  "observation": {},
  "joints": {"state": [*JOINTS, "finger_r1"]},
  "action": {"order": [*JOINTS, "gripper"]},
  "cameras": {x: {"height": 24, "width": 32} for x in ("global", "wrist")},
}


class Camera:
  """A camera, which is unplugged after some frames."""

  def __init__(self, clock: Clock, frames: int):
    self._clock, self._left = clock, frames

  def get_observation(self) -> Frame:
    self._left -= 1
    if self._left < 0:
      raise DeviceError("camera wrist: sent no frame for 1 s: check its cable")
    return Frame(self._clock.now() - 0.02, np.full((24, 32, 3), 90, np.uint8))


class Judge:
  """A judge of a scene without a state."""

  def solved(self) -> bool:
    return False

  def environment(self) -> None:
    return None


class Episode:
  """A player with its board, in the first episode."""

  def __init__(
    self,
    board: Blackboard,
    thinks: Callable[[int], float] = lambda _: 0.005,
    *,
    frames: int = 1000,
    recorder: Recorder | None = None,
    judge: Any = None,
  ):
    """``thinks``: time in s that the policy takes for an action, by its number."""
    self.board, self.clock, self.times = board, TurnedClock(), []

    def act(seen: Any, episode: int, instant: int) -> np.ndarray:
      self.clock.sleep(thinks(instant))
      self.times.append(self.clock.now() - START)
      return np.full(7, 0.25, np.float32)

    robot = Robot("double", CONTRACT, Cell(), self.clock)
    cameras: Any = [Camera(self.clock, 1000), Camera(self.clock, frames)]
    self.player = Player(robot, board, cameras, act, judge=judge, recorder=recorder)
    state = {"number": 1, "phase": Phase.PLAY, "time": START - 0.002}
    board["order"].write({"number": 1, "phase": Phase.PLAY})
    state["gripper_time"] = START - 0.02
    board["state"].write({**state, "position": np.arange(6.0), "gripper": 0.5})

  def play(self) -> None:
    self.player.play(1, 0)

  @property
  def found(self) -> Any:
    return self.board["policy"].read()


@pytest.fixture
def board() -> Iterator[Blackboard]:
  with Blackboard() as made:
    yield made


def test_an_action_in_each_period(board):
  episode = Episode(board)
  episode.play()
  np.testing.assert_allclose(episode.times, 0.005 + PERIOD * np.arange(10), atol=1e-6)
  assert episode.found["over"] and not episode.found["missed"]


@pytest.mark.parametrize("late", [0.16, 0.31, 0.46])
def test_a_late_policy_drops_periods_and_keeps_their_grid(board, late):
  """Actions that catch up would follow each other within a few ms."""
  episode = Episode(board, lambda i: late if i == 2 else 0.005)
  episode.play()
  dropped = int(late / PERIOD)
  assert np.diff(episode.times).min() > 0.1  # From the late one to the next.
  after = (np.array(episode.times[3:]) - 0.005) / PERIOD
  np.testing.assert_allclose(after, after[0].round() + np.arange(len(after)), atol=1e-6)
  assert episode.found["missed"] == dropped
  assert episode.found["actions"] == 10 - dropped  # The time limit stays.


def test_no_period_after_the_time_limit_is_missed(board):
  episode = Episode(board, lambda i: 0.46 if i == 9 else 0.005)
  episode.play()
  assert (episode.found["actions"], episode.found["missed"]) == (10, 0)


@pytest.mark.parametrize(
  ("elapsed", "number"), [(0.01, 4), (0.46, 4), (0.599, 4), (0.61, 5), (1.2, 8)]
)
def test_the_next_period_is_one_that_has_not_begun(elapsed, number):
  assert next_period(3, elapsed, PERIOD) == number


@contextlib.contextmanager
def logging(folder: Path, judged: bool) -> Generator[Recorder]:
  pytest.importorskip("pyarrow")
  with Recorder(folder, CONTRACT, judged=judged) as recorder:
    yield recorder


def test_an_interrupted_episode_is_in_the_log(board, tmp_path):
  with logging(tmp_path / "log", False) as recorder:
    episode = Episode(board, frames=4, recorder=recorder)
    with pytest.raises(DeviceError, match="sent no frame"):
      episode.play()
    assert episode.found["index"] == -1  # As if the process were killed here.
    episode.player.end_episode()
    episode.player.end_episode()  # Once.
  assert (episode.found["ended"], episode.found["index"]) == (1, 0)
  assert not episode.found["over"]
  (kept,) = lerobot.read(tmp_path / "log").episodes
  assert len(kept.actions) == 4 and (kept.actions == 0.25).all()
  assert len(list(kept.images("observation.images.wrist"))) == 4
  assert not list((tmp_path / "log").rglob("*.part*"))


@pytest.mark.parametrize(("judge", "success"), [(None, None), (Judge(), False)])
def test_only_a_robot_that_can_judge_labels_success(board, tmp_path, judge, success):
  with logging(tmp_path / "log", judge is not None) as recorder:
    Episode(board, recorder=recorder, judge=judge).play()
  dataset = lerobot.read(tmp_path / "log")
  assert dataset.episodes[0].success is success
  info = (tmp_path / "log" / "meta" / "info.json").read_text()
  assert ("next.success" in info) == (judge is not None)


def test_the_log_has_the_measured_times(board, tmp_path):
  with logging(tmp_path / "log", False) as recorder:
    Episode(board, recorder=recorder).play()
  dataset = lerobot.read(tmp_path / "log")
  names = ["global", "wrist", "joints", "gripper", "action"]
  assert dataset.names["times"] == names
  times = dict(zip(names, dataset.episodes[0].columns["times"].T, strict=True))
  grid = PERIOD * np.arange(11)
  np.testing.assert_allclose(times["action"][:-1], grid[:-1] + 0.005, atol=1e-5)
  np.testing.assert_allclose(times["wrist"], grid - 0.02, atol=1e-5)
  np.testing.assert_allclose(times["joints"], -0.002, atol=1e-5)
  np.testing.assert_allclose(times["gripper"], -0.02, atol=1e-5)


def test_the_log_has_what_the_last_action_has_led_to(board, tmp_path):
  with logging(tmp_path / "log", False) as recorder:
    episode = Episode(board, recorder=recorder)
    episode.play()
  (kept,) = lerobot.read(tmp_path / "log").episodes
  assert len(kept.actions) == episode.found["actions"] + 1
  assert (kept.actions[:-1] == 0.25).all()
  np.testing.assert_array_equal(kept.actions[-1], [0, 0, 0, 0, 0, 0, 0.25])
  assert len(list(kept.images("observation.images.global"))) == len(kept.actions)


def test_an_episode_without_instants_is_not_in_the_log(board, tmp_path):
  with logging(tmp_path / "log", False) as recorder:
    episode = Episode(board, recorder=recorder)
    board["state"].write({"phase": Phase.IDLE})
    episode.play()
  assert (episode.found["ended"], episode.found["index"]) == (1, -1)
