"""The policy process: cameras and joints to actions, once per control period.

The only module of the runtime that runs JAX, apart from the simulated cameras.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import contextlib
from importlib.metadata import version
import os
from pathlib import Path
import threading
import time
from typing import Any

import numpy as np

from apnpql_jax.robot import devices, policy_folder
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.board import Board, Phase
from apnpql_jax.robot.control_process import Pipe
from apnpql_jax.robot.devices import Robot
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.protocols import Camera, Frame
from apnpql_jax.robot.recorder import Recorder
from apnpql_jax.robot.replay import recorded_actions

HISTORY = 3
"""Robot states in an observation."""

Act = Callable[[dict[str, np.ndarray], int, int], np.ndarray]
"""(observation with a batch axis, episode, instant) -> action f32[7]."""


class Observer:
  """Puts together what the policy sees: states, tool, images and their history."""

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


def load_program(folder: PolicyFolder, seed: int) -> Act:
  """Returns the exported program, compiled.

  Raises:
    FileError: JAX cannot load it.
  """
  from apnpql_jax import runtime

  about = folder.contract
  if version("jaxlib") == about["origin"]["exported_with"]["packages"]["jaxlib"]:
    # The last bits depend on these flags; other versions of XLA may not have them.
    os.environ.setdefault("XLA_FLAGS", about["program"]["xla_flags"])
  runtime.configure()
  import jax
  from jax import export

  from apnpql_jax.errors import FileError, one_line

  try:
    call = jax.jit(export.deserialize(bytearray(folder.program.read_bytes())).call)
    fields = folder.contract["observation"]["fields"]
    empty = {k: np.zeros((1, *f["shape"]), f["dtype"]) for k, f in fields.items()}
    np.asarray(call(empty, np.zeros(2, np.uint32)))
  except Exception as error:  # Whatever JAX raises for a program it cannot run.
    raise FileError(
      f"{str(folder.program)!r} cannot be loaded: {one_line(error)}"
    ) from error

  def act(observation: dict[str, np.ndarray], episode: int, instant: int) -> np.ndarray:
    key = np.array([seed, episode * 100_000 + instant], np.uint32)
    return np.asarray(call(observation, key))[0]

  return act


def replaying(actions: Sequence[np.ndarray]) -> Act:
  """Returns a policy that repeats recorded episodes; then it stands still."""

  def act(observation: dict[str, np.ndarray], episode: int, instant: int) -> np.ndarray:
    del observation
    recorded = actions[episode % len(actions)]
    if instant < len(recorded):
      return np.asarray(recorded[instant])
    return np.append(np.zeros(6), recorded[-1][6])

  return act


def main(robot: Robot, board_name: str, options: dict[str, Any], peer: Pipe) -> None:
  """Runs the process.

  Args:
    robot: What to open.
    board_name: Name of the board.
    options: ``policy``: folder; ``seed``; ``log``: folder of a log or None; ``replay``:
      log whose actions to repeat or None.
    peer: Its other end is with the control process alone, whose end ends this one.
  """
  devices.leave_interrupts_to_the_main_process()
  threading.Thread(target=_end_with, args=(peer,), daemon=True).start()
  board = Board(board_name)
  try:
    folder = policy_folder.load(Path(options["policy"]))
    if options["replay"] is None:
      act = load_program(folder, options["seed"])
    else:
      recorded = recorded_actions(Path(options["replay"]), folder.contract)
      act = replaying(recorded)
    with contextlib.ExitStack() as stack:
      cameras = stack.enter_context(devices.open_cameras(robot))
      recorder = None
      if options["log"] is not None:
        recorder = stack.enter_context(Recorder(Path(options["log"]), folder.contract))
      for camera in cameras:  # The first frame may take long.
        camera.get_observation()
      board["policy"].write({"ready": 1})
      _serve(Player(robot, board, cameras, act, recorder))
  except Exception as error:  # Any end but the ordered one is one line for the user.
    board["policy"].write({"error": devices.reason(error)})
  finally:
    board.close()


def _end_with(peer: Pipe) -> None:
  """Ends this process when the one at the other end has ended."""
  with contextlib.suppress(EOFError, OSError):
    peer.recv()
  os._exit(1)


def _serve(player: Player) -> None:
  """Plays each episode that begins, until the session ends."""
  played, episode = 0, 0
  while True:
    order = player.board["order"].read()
    state = player.board["state"].read()
    if order["phase"] == Phase.QUIT:
      return
    begun = state["phase"] == Phase.PLAY and state["number"] == order["number"]
    if begun and order["number"] != played:
      played = int(order["number"])
      player.play(played, episode)
      episode += 1
    time.sleep(0.002)


class Player:
  """Plays episodes at the control period."""

  def __init__(
    self,
    robot: Robot,
    board: Board,
    cameras: Sequence[Camera],
    act: Act,
    recorder: Recorder | None = None,
  ):
    """Keeps the cameras; a camera may have ``solved``, as the simulated ones do."""
    self.board, self._cameras, self._act = board, cameras, act
    self._contract, self._recorder = robot.contract, recorder
    self._clock = robot.clock
    self._solved = getattr(cameras[0], "solved", lambda: False)
    self._observer = Observer(robot.contract)

  def play(self, order: int, episode: int) -> None:
    """Plays until the order changes, the task is solved or the time is over."""
    board, period = self.board, self._contract["control_period_s"]
    most = round(self._contract["time_limit_s"] / period)
    self._observer.begin()
    begin, solved, instant = self._clock.now(), False, 0
    while True:
      frames = [camera.get_observation() for camera in self._cameras]
      state = board["state"].read()
      if state["number"] != order or state["phase"] != Phase.PLAY:
        break
      solved = instant > 0 and self._solved()
      if solved or instant >= most:
        break
      seen = self._observer.observe(state["position"], float(state["gripper"]), frames)
      action = self._act(seen, episode, instant)
      now, instant = self._clock.now(), instant + 1
      board["action"].write(
        {
          "order": order,
          "number": instant,
          "time": now,
          "values": action,
          "frames": [frame.time for frame in frames],
        }
      )
      if self._recorder is not None:
        self._recorder.add(state, action, frames)
      delay = now - begin - (instant - 1) * period
      board["policy"].write(
        {"order": order, "actions": instant, "over": 0, "delay": delay}
      )
      self._wait(begin + instant * period, order)
    board["policy"].write({"order": order, "over": 1, "solved": int(solved)})
    if self._recorder is not None:
      self._recorder.end_episode(solved)

  def _wait(self, until: float, order: int) -> None:
    """Waits, unless the episode ends before."""
    while (left := until - self._clock.now()) > 0:
      if self.board["order"].read()["number"] != order:
        return
      self._clock.sleep(min(left, 0.01))
