"""Real processes: no JAX in control, and the end of one ends the motion of the others.

A slow clock makes the times independent of the load of the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
import contextlib
import dataclasses
from multiprocessing import get_context
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

import numpy as np
from rigs import NEUTRAL

from apnpql_jax.robot import control_process
from apnpql_jax.robot.blackboard import Blackboard, Phase, text
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.description import Robot
from apnpql_jax.robot.simulated import devices as simulated, process as simulation
from apnpql_jax.robot.supervisor import Mode

CONTRACT: dict[str, Any] = {
  "task": "push_plate",
  "control_period_s": 0.15,
  "joints": {
    "ranges": [[-6.28, 6.28]] * 7,
    "gripper": {"open_rad": 0.0, "closed_rad": 1.1},
  },
}
CLOCK = Clock(10.0)
PARENT_KILLED = """
import sys
sys.path[:0] = sys.argv[1:3]
if __name__ == "__main__":
  import os, signal
  import test_processes as t
  with t.rig() as (board, rig):
    t.start_motion(board)
    print(rig.control.pid, rig.plant, rig.policy.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def policy(board_name: str, peer: Any, clock: Clock) -> None:
  """Moves the shoulder as fast as allowed, without cameras or JAX."""
  board, number = Blackboard(board_name), 0
  while not peer.poll(0):
    state, now = board["state"].read(), clock.now()
    if state["phase"] == Phase.PLAY:
      number += 1
      board["action"].write(
        {
          "order": state["number"],
          "number": number,
          "time": now,
          "values": np.array([1.0, 0, 0, 0, 0, 0, 1]),
          "frames": np.full(2, now),
        }
      )
    clock.sleep(0.15)


def control(
  robot: Robot, board_name: str, options: dict, events: Any, peer: Any
) -> None:
  """Runs the control process, then reports whether it has imported JAX."""
  control_process.main(robot, board_name, options, events, peer)
  events.send((0.0, "jax", str("jax" in sys.modules)))


@dataclasses.dataclass
class Rig:
  """The processes."""

  control: Any
  policy: Any
  plant: str
  events: Any

  def reasons(self) -> list[str]:
    found = []
    with contextlib.suppress(EOFError):
      while self.events.poll(1.0):
        event = self.events.recv()
        found.append(event if isinstance(event, str) else event[2])
    return found


@contextlib.contextmanager
def rig(
  target: Callable[[str, Any, Clock], None] = policy, contract: dict = CONTRACT
) -> Generator[tuple[Blackboard, Rig]]:
  """Starts a plant, a control process, and as the policy a function of this module."""
  context = get_context("spawn")
  robot = Robot("simulated", contract, Cell(), CLOCK)
  with simulated.started(robot) as robot, Blackboard() as board:
    receiver, sender = context.Pipe(duplex=False)
    one, other = context.Pipe()
    args = robot, board.name, {"admittance": True}, sender, one
    processes = [
      context.Process(target=control, args=args),
      context.Process(target=target, args=(board.name, other, CLOCK)),
    ]
    for process in processes:
      process.start()
    for end in (sender, one, other):
      end.close()
    try:
      until(lambda: board["state"].read()["time"] > 0)
      yield board, Rig(*processes, robot.plant, receiver)
    finally:
      board["order"].write({"number": 99, "phase": Phase.QUIT})
      for process in processes:
        process.join(5.0 * CLOCK.slowdown)
        process.kill()
        process.join()


def until(condition: Callable[[], bool], seconds: float = 120.0) -> float:
  """Waits for a condition; returns the time of the session that it took."""
  begin = time.monotonic()
  while not condition():
    assert time.monotonic() - begin < seconds
    time.sleep(0.005)
  return (time.monotonic() - begin) / CLOCK.slowdown


def start_motion(board: Blackboard) -> int:
  """Homes the arm, and returns the number of the order when the policy moves it.

  A busy machine may starve a process for so long that a limit stops the arm, which is
  not what these tests are about. So it tries again.
  """
  reasons = []
  for number in (1, 3, 5):
    order = {"number": number, "phase": Phase.HOME, "target": NEUTRAL, "close": 1}
    board["order"].write(order)
    until(lambda n=number: is_done(board, n))
    if np.abs(board["state"].read()["position"] - NEUTRAL).max() < 0.01:
      board["order"].write({"number": number + 1, "phase": Phase.PLAY})
      until(lambda n=number: is_fast(board) or is_done(board, n + 1))
      if is_fast(board):
        return number + 1
    reasons.append(text(board["state"].read()["reason"]))
  raise AssertionError(f"the arm stopped: {reasons}")


def is_done(board: Blackboard, number: int) -> bool:
  state = board["state"].read()
  return bool(state["number"] == number and state["done"])


def is_fast(board: Blackboard) -> bool:
  return abs(board["state"].read()["velocity"][0]) > 0.5


def speed(plant: Blackboard) -> float:
  """Returns the arm's largest joint velocity, rad/s."""
  return float(np.abs(plant["plant"].read()["velocity"]).max())


def test_a_killed_policy_brings_the_arm_to_rest_and_control_has_no_jax():
  with rig() as (board, run), Blackboard(run.plant, simulation.RECORDS) as plant:
    start_motion(board)
    run.policy.kill()
    assert until(lambda: speed(plant) < 0.01) < 0.5
    until(lambda: not run.control.is_alive())
    state = board["state"].read()
    assert state["mode"] == Mode.STOP
    assert state["reason"] == b"policy: its process has ended"
    reasons = run.reasons()
    assert "policy: its process has ended" in reasons
    assert reasons[-1] == "False"  # Whether JAX was imported.


def test_a_killed_control_process_ends_the_policy_and_the_arm_keeps_its_place():
  with rig() as (board, run), Blackboard(run.plant, simulation.RECORDS) as plant:
    start_motion(board)
    run.control.kill()
    until(lambda: not run.policy.is_alive())
    assert until(lambda: speed(plant) < 0.01) < 0.5


def test_a_killed_main_process_ends_all(tmp_path):
  here = Path(__file__).parent
  script = tmp_path / "main.py"
  script.write_text(PARENT_KILLED)
  output = tmp_path / "output"  # Not a pipe, which the processes would keep open.
  with output.open("w") as file:
    command = [sys.executable, str(script), str(here.parents[1]), str(here)]
    done = subprocess.run(command, stdout=file, stderr=file, timeout=300)
  assert done.returncode == -signal.SIGKILL, output.read_text()
  control_pid, _, policy_pid = output.read_text().split()
  for pid in (control_pid, policy_pid):
    until(lambda pid=pid: not _alive(int(pid)))


def _alive(pid: int) -> bool:
  try:
    state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
  except OSError:
    return False
  return state != "Z" and os.path.exists(f"/proc/{pid}")


def test_a_simulated_arm_can_be_reset():
  robot = Robot("simulated", CONTRACT, Cell(), CLOCK)
  with simulated.started(robot) as robot, simulated.opened(robot) as plant:
    begin = plant["plant"].read()["position"]
    np.testing.assert_allclose(begin, NEUTRAL + simulation.PARKED, atol=1e-3)
    plant["servo"].write({"follow": 1, "target": NEUTRAL})
    until(lambda: np.abs(plant["plant"].read()["position"] - NEUTRAL).max() < 0.02)
    plant["servo"].write({"follow": 0})
    plant["scene"].write({"parked": 1})
    until(lambda: plant["plant"].read()["parked"] == 1)
    np.testing.assert_allclose(plant["plant"].read()["position"], begin, atol=1e-3)
