"""A log is repeated only in the place of a policy whose actions mean the same."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apnpql_jax.data import lerobot
from apnpql_jax.errors import FileError
from apnpql_jax.robot import recorder, replay
from apnpql_jax.robot.protocols import Frame

pytest.importorskip("pyarrow")

JOINTS = ["pan", "lift", "elbow", "w1", "w2", "w3"]
NEUTRAL = [-1.9, -1.8, 2.0, -1.8, -1.6, -0.3]
CONTRACT: dict[str, Any] = {
  "task": "push_plate",
  "control_period_s": 0.15,
  "joints": {"state": [*JOINTS, "finger"]},
  "cameras": {x: {"height": 16, "width": 16} for x in ("global", "wrist")},
  "action": {
    "order": [*JOINTS, "gripper"],
    "meaning": "desired joint velocities",
    "units": ["rad/s"] * 6 + ["1"],
    "low": [-1.0] * 6 + [0.0],
    "high": [1.0] * 7,
  },
}
STATE = {
  "position": np.array(NEUTRAL),
  "gripper": 0.5,
  "command": np.array(NEUTRAL),
  "wrench": np.zeros(6),
  "time": 0.0,
  "gripper_time": 0.0,
}


def changed(*keys: str, value: Any) -> dict[str, Any]:
  """Returns the contract with another value."""
  contract = copy.deepcopy(CONTRACT)
  part = contract
  for key in keys[:-1]:
    part = part[key]
  part[keys[-1]] = value
  return contract


def log(folder: Path, *episodes: np.ndarray, contract: Any = CONTRACT) -> Path:
  """Records episodes, as a run does."""
  frames = [Frame(0.0, np.zeros((16, 16, 3), np.uint8))] * 2
  with recorder.Recorder(folder, contract, judged=False) as writer:
    for actions in episodes:
      for action in actions:
        writer.add(0.0, 0.0, STATE, action, frames)
      writer.end_episode(None)
  return folder


def velocities() -> np.ndarray:
  """Returns five actions."""
  return np.random.default_rng(0).uniform(0, 1, (5, 7)).astype(np.float32)


def test_a_log_of_the_same_policy_gives_its_actions(tmp_path):
  (actions,) = replay.recorded_actions(log(tmp_path / "log", velocities()), CONTRACT)
  np.testing.assert_array_equal(actions, velocities())


def test_recorded_episodes_are_repeated_and_then_the_arm_stands_still(tmp_path):
  folder, other = tmp_path / "log", 0.5 * velocities()[:3]
  log(folder, velocities(), other)
  act = replay.replaying(replay.recorded_actions(folder, CONTRACT))
  for episode, expected in enumerate((velocities(), other, velocities())):
    found = [act({}, episode, instant) for instant in range(len(expected))]
    np.testing.assert_array_equal(found, expected)
    rest = act({}, episode, len(expected))
    np.testing.assert_array_equal(rest, [0, 0, 0, 0, 0, 0, expected[-1][6]])


@pytest.mark.parametrize(
  ("keys", "value", "message"),
  [
    (["control_period_s"], 0.1, "its actions are 0.1 s apart, the policy's 0.15 s"),
    (["task"], "stack_box", "its task is 'stack_box', the policy's 'push_plate'"),
    (["action", "order"], [*JOINTS[::-1], "gripper"], "its actions are of .'w3'"),
    (["action", "meaning"], "joint angles", "meaning of its actions: 'joint angles'; "),
    (["action", "units"], ["rad"] * 6 + ["1"], "units of its actions: .'rad', "),
    (["action", "high"], [2.0] * 7, "high of its actions: .2.0, "),
  ],
)
def test_another_log_is_refused_with_the_difference(tmp_path, keys, value, message):
  folder = log(tmp_path / "log", velocities(), contract=changed(*keys, value=value))
  with pytest.raises(FileError, match=f"cannot be replayed: {message}") as error:
    replay.recorded_actions(folder, CONTRACT)
  assert "\n" not in str(error.value)


def test_joint_angles_are_no_velocities(tmp_path):
  folder = log(tmp_path / "log", np.array([[*NEUTRAL, 1.0]]))
  with pytest.raises(FileError, match="an action of pan is -1.9, outside of -1 to 1"):
    replay.recorded_actions(folder, CONTRACT)


@pytest.mark.parametrize("about", [{}, {"contract": "abc"}, {"contract": {}}])
def test_a_dataset_without_a_contract_is_refused(tmp_path, about):
  """Such as one of another program, whose actions may be joint angles."""
  folder = tmp_path / "log"
  names = tuple(CONTRACT["action"]["order"])
  vectors = {lerobot.STATE: names, lerobot.ACTION: names}
  with lerobot.Writer(
    folder, fps=1 / 0.15, vectors=vectors, images={}, robot_type="x", about=about
  ) as writer:
    writer.add({lerobot.STATE: np.zeros(7), lerobot.ACTION: np.zeros(7)})
    writer.end_episode("push_plate", False)
  with pytest.raises(FileError, match="it has no contract with the meaning of"):
    replay.recorded_actions(folder, CONTRACT)


def test_a_log_without_episodes_is_refused(tmp_path):
  with recorder.Recorder(tmp_path / "log", CONTRACT, judged=False):
    pass
  with pytest.raises(FileError, match="has no episodes"):
    replay.recorded_actions(tmp_path / "log", CONTRACT)
