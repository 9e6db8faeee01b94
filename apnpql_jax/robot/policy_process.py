"""The policy process: cameras and joints to actions, once per control period.

The only module of the runtime that runs JAX, apart from the simulated cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
from importlib.metadata import version
import json
import math
from multiprocessing.connection import Connection
import os
from pathlib import Path
import threading
import time
from typing import Any

import numpy as np

from apnpql_jax.errors import FileError, one_line, reason
from apnpql_jax.robot import devices, interrupts, policy_folder
from apnpql_jax.robot.blackboard import Blackboard, Phase, text
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.orders import comes_true
from apnpql_jax.robot.player import Act, Player
from apnpql_jax.robot.policy_folder import PolicyFolder
from apnpql_jax.robot.protocols import CAMERAS, Camera
from apnpql_jax.robot.recorder import Recorder
from apnpql_jax.robot.replay import recorded_actions, replaying

END_S = 60.0
"""Time to write an interrupted episode after the end of the control process, s."""


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


def main(
  robot: Robot, board_name: str, options: dict[str, Any], peer: Connection
) -> None:
  """Runs the process.

  Args:
    robot: What to open.
    board_name: Name of the board.
    options: ``policy``: folder; ``seed``; ``log``: folder of a log or None; ``replay``:
      log whose actions to repeat or None.
    peer: Pipe to the control process, which alone holds the other end. If that process
      ends, so does this one. Gets the error that ends this process, as text.
  """
  interrupts.leave_to_the_main_process()
  ready, ending = threading.Event(), threading.Event()
  args = peer, ready, ending
  threading.Thread(target=_end_with, args=args, daemon=True).start()
  board = Blackboard(board_name)

  def tell(error: Exception) -> None:
    """Ends the motion and the session, with one line for the user."""
    line = reason(error)
    if not text(board["policy"].read()["error"]):
      board["policy"].write({"error": line})
    with contextlib.suppress(OSError):
      peer.send(line)

  try:
    folder = policy_folder.load(Path(options["policy"]))
    if folder.contract != robot.contract:
      raise FileError(f"{str(folder.path)!r} was replaced meanwhile; start again")
    if options["replay"] is None:
      act = load_program(folder, options["seed"])
    else:
      recorded = recorded_actions(Path(options["replay"]), folder.contract)
      act = replaying(recorded)
    with contextlib.ExitStack() as stack:
      cameras, judge = stack.enter_context(devices.open_cameras(robot))
      recorder = None
      if options["log"] is not None:
        recorder = stack.enter_context(
          Recorder(
            Path(options["log"]),
            folder.contract,
            judged=judge is not None,
            environment=() if judge is None else judge.environment_names(),
            devices=_described(robot, board, cameras),
          )
        )
      for camera in cameras:  # The first frame may take long.
        camera.get_observation()
      player = Player(
        robot, board, cameras, act, judge=judge, recorder=recorder, ending=ending
      )
      stack.callback(player.end_episode)
      board["policy"].write({"ready": 1})
      ready.set()
      try:
        _serve(player, ending)
      except Exception as error:
        tell(error)  # At once: the arm must not move while the episode is written.
        raise
  except Exception as error:  # Any end but the ordered one is one line for the user.
    tell(error)
  finally:
    board.close()


def _described(
  robot: Robot, board: Blackboard, cameras: Sequence[Camera]
) -> dict[str, Any]:
  """Returns what all devices say of themselves, once arm and gripper are connected.

  If they cannot be, this process ends with the control process.
  """
  comes_true(lambda: bool(text(board["devices"].read()["arm"])), math.inf)
  found = board["devices"].read()
  return {
    "robot": robot.kind,
    "arm": json.loads(text(found["arm"])),
    "gripper": json.loads(text(found["gripper"])),
    "cameras": {x: y.describe() for x, y in zip(CAMERAS, cameras, strict=True)},
  }


def _end_with(
  peer: Connection, ready: threading.Event, ending: threading.Event
) -> None:
  """Ends this process when the one at the other end has ended.

  Before it is ``ready``, there is no episode to write.
  """
  with contextlib.suppress(EOFError, OSError):
    peer.recv()
  ending.set()
  time.sleep(END_S if ready.is_set() else 0.0)
  os._exit(1)


def _serve(player: Player, ending: threading.Event) -> None:
  """Plays each episode that begins, until the session ends."""
  played, episode = 0, 0
  while not ending.is_set():
    order = player.board["order"].read()
    state = player.board["state"].read()
    if order["phase"] == Phase.QUIT:
      return
    begun = state["phase"] == Phase.PLAY and state["number"] == order["number"]
    if begun and order["number"] != played:
      played = int(order["number"])
      player.play(played, episode)
      episode += 1
    time.sleep(TIMESTEP)
