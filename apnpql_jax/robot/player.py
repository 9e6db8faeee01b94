"""The policy's side of an episode: what it sees, and an action in each period."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import math
import threading
from typing import Any

import numpy as np

from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.blackboard import Blackboard, Phase
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.protocols import Camera, Frame, Judge
from apnpql_jax.robot.recorder import Recorder

HISTORY = 3
"""Robot states in an observation."""

Act = Callable[[dict[str, np.ndarray], int, int], np.ndarray]
"""(observation with a batch axis, episode, instant) -> action f32[7]."""


class Observer:
  """Builder of the policy's observations: states, tool, images and their history."""

  def __init__(self, contract: dict[str, Any]):
    """Reads how many instants the policy sees."""
    instants = contract["observation"].get("instants", {"count": 0})["count"]
    self._instants, self._model = instants, ArmModel()
    self._states: deque[np.ndarray] = deque(maxlen=HISTORY)
    self._seen: deque[dict[str, np.ndarray]] = deque(maxlen=max(1, instants))

  def begin(self) -> None:
    """Forgets the former episode."""
    self._states.clear()
    self._seen.clear()

  def observe(
    self, joints: np.ndarray, gripper: float, frames: Sequence[Frame]
  ) -> dict[str, np.ndarray]:
    """Adds an instant and returns the observation, by field of the contract."""
    state = np.append(joints, gripper).astype(np.float32)
    self._states.extend([state] * (1 if self._states else HISTORY))
    tool = self._model.tool_position(joints).astype(np.float32)
    overview, wrist = (frame.image for frame in frames)
    seen = {
      "robot": np.concatenate(self._states),
      "tool": tool,
      "global_image": overview,
      "wrist_image": wrist,
    }
    self._seen.extend([seen] * (1 if self._seen else self._seen.maxlen or 1))
    if not self._instants:
      return {name: x[None] for name, x in seen.items()}
    return {k: np.stack([x[k] for x in self._seen])[None] for k in seen}


def next_period(number: int, elapsed: float, period: float) -> int:
  """Returns the number of the first period to begin, counted from 0.

  A late action skips the periods that have begun in the meantime. Catching up would
  send actions in quick succession, which never happens in training.

  Args:
    number: Number of the present period.
    elapsed: Time since the beginning of period 0, s.
    period: Length of a period, s.
  """
  return max(number + 1, math.ceil(elapsed / period))


class Player:
  """Player of episodes at the control period."""

  def __init__(
    self,
    robot: Robot,
    board: Blackboard,
    cameras: Sequence[Camera],
    act: Act,
    *,
    judge: Judge | None = None,
    recorder: Recorder | None = None,
    ending: threading.Event | None = None,
  ):
    """Keeps what it plays with.

    Args:
      robot: The robot.
      board: The board.
      cameras: The cameras, connected.
      act: The policy.
      judge: The judge of their scene, if there is one.
      recorder: Gets each episode.
      ending: Ends the episode when it is set.
    """
    self.board, self._cameras, self._act = board, cameras, act
    self._contract, self._recorder = robot.contract, recorder
    self._clock, self._ending = robot.clock, ending or threading.Event()
    self._judge = judge
    self._observer = Observer(robot.contract)
    self._order, self._solved, self._ended = 0, False, 0

  def play(self, order: int, episode: int) -> None:
    """Plays until the order changes, the task is solved or the time is over."""
    self._order, self._solved = order, False
    zeros = dict.fromkeys(("actions", "missed", "over", "solved"), 0)
    self.board["policy"].write({"order": order, "index": -1, **zeros})
    self._play(episode)
    self.board["policy"].write({"over": 1, "solved": int(self._solved)})
    self.end_episode()

  def end_episode(self) -> None:
    """Writes the episode to the log, also one that a fault has interrupted."""
    if self._order == self._ended:
      return
    self._ended, index = self._order, None
    if self._recorder is not None:
      success = None if self._judge is None else self._solved
      index = self._recorder.end_episode(success)
    self.board["policy"].write(
      {"ended": self._order, "index": -1 if index is None else index}
    )

  def _play(self, episode: int) -> None:
    period = self._contract["control_period_s"]
    most = round(self._contract["time_limit_s"] / period)
    self._observer.begin()
    begin, number, actions = self._clock.now(), 0, 0
    action = np.zeros(7)
    while True:
      frames = [camera.get_observation() for camera in self._cameras]
      state = self.board["state"].read()
      if self._is_over(state):
        return
      self._solved = bool(self._judge and actions and self._judge.solved())
      if self._solved or number >= most:  # What the last action has led to.
        rest = np.append(np.zeros(6), action[6])
        self._record(begin, self._clock.now(), state, rest, frames)
        return
      seen = self._observer.observe(state["position"], float(state["gripper"]), frames)
      action = self._act(seen, episode, actions)
      now, actions = self._clock.now(), actions + 1
      self._send(actions, now, action, frames)
      self._record(begin, now, state, action, frames)
      delay = now - begin - number * period
      number = next_period(number, now - begin, period)
      self.board["policy"].write(
        {"actions": actions, "missed": min(number, most) - actions, "delay": delay}
      )
      self._wait(begin + number * period)

  def _record(self, *instant: Any) -> None:
    """Keeps an instant for the log, if there is one; arguments as ``Recorder.add``."""
    if self._recorder is not None:
      known = None if self._judge is None else self._judge.environment()
      self._recorder.add(*instant, known)

  def _is_over(self, state: Any) -> bool:
    playing = state["number"] == self._order and state["phase"] == Phase.PLAY
    return self._ending.is_set() or not playing

  def _send(
    self, number: int, now: float, action: np.ndarray, frames: Sequence[Frame]
  ) -> None:
    self.board["action"].write(
      {
        "order": self._order,
        "number": number,
        "time": now,
        "values": action,
        "frames": [frame.time for frame in frames],
      }
    )

  def _wait(self, until: float) -> None:
    """Waits, unless the episode ends before."""
    while (left := until - self._clock.now()) > 0:
      if self._ending.is_set() or self.board["order"].read()["number"] != self._order:
        return
      self._clock.sleep(min(left, 0.01))
