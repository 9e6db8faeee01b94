"""The process of the simulated robot: a ``Plant`` behind its board.

It draws the reset states of the task, so it imports the task and with it JAX, but it
runs nothing in JAX.
"""

from __future__ import annotations

import contextlib
import importlib
from multiprocessing import parent_process
from typing import Any

import numpy as np

from apnpql_jax.errors import reason
from apnpql_jax.robot import interrupts
from apnpql_jax.robot.blackboard import TEXT, Blackboard
from apnpql_jax.robot.clock import Clock
from apnpql_jax.robot.limits import TIMESTEP
from apnpql_jax.robot.simulated.plant import Plant, Servo

_MOST = {"qpos": 128, "qvel": 128, "mocap_pos": 24, "mocap_quat": 32}
"""Room for arrays of the scene."""

RECORDS = {
  # From the plant: its whole state, see ``Scene``.
  "plant": [
    ("ready", "i8"),
    ("scene", "i8"),
    ("parked", "i8"),
    ("time", "f8"),
    ("position", "f8", 6),
    ("velocity", "f8", 6),
    ("wrench", "f8", 6),
    ("gripper", "f8"),
    ("zeroed", "i8"),
    ("variant", "i8"),
    ("error", TEXT),
    *((name, "f8", size) for name, size in _MOST.items()),
  ],
  "servo": [("follow", "i8"), ("target", "f8", 6), ("zero", "i8")],
  "grip": [("command", "i8")],
  # From the main process: the number of the reset state to show, and how often the arm
  # was to be put back where it began.
  "scene": [("number", "i8"), ("parked", "i8"), ("quit", "i8")],
}

HOLD, OPEN, CLOSE = range(3)
"""Commands to the gripper; the empty record moves nothing."""

_CATCH_UP_S = 0.02
"""Delay that the plant makes up for; a longer one lets its time stand still."""

_SETTLE_S = 0.5
"""Time for which new objects come to rest."""

PARKED = np.array([0.15, 0.1, -0.1, 0.1, 0.05, -0.1])
"""Where the arm begins, rad from the neutral pose, so that it has to go there."""


class Scene:
  """A task's objects: reset states that are placed in the plant, and its state."""

  def __init__(self, task: Any, *, seed: int):
    """Keeps a ``tasks.Task``."""
    self._task, self._rng = task, np.random.default_rng(seed)

  def place(self, plant: Plant) -> int:
    """Draws a reset state, places it, and returns the variant of its objects."""
    draw = self._task.sample_resets(self._rng, 1)
    variant = int(draw.variant[0])
    for name, values in self._task.scene.variants.items():
      getattr(plant.model, name)[...] = values[variant]
    plant.place(draw.qpos[0], draw.mocap_pos[0], draw.mocap_quat[0])
    return variant

  def park(self, plant: Plant) -> None:
    """Puts the arm near the neutral pose, as an operator would free it."""
    scene = self._task.scene
    plant.put_arm(scene.keyframe("neutral")[scene.arm_qpos] + PARKED)

  @staticmethod
  def state_of(plant: Plant) -> dict[str, np.ndarray]:
    """Returns the arrays of ``_MOST``, padded."""
    found = {}
    for name, size in _MOST.items():
      values = np.asarray(getattr(plant.data, name)).reshape(-1)
      found[name] = np.pad(values, (0, size - len(values)))
    return found


def main(name: str, task_name: str, options: dict[str, Any]) -> None:
  """Runs the process of the plant.

  Args:
    name: Name of its board, with ``RECORDS``.
    task_name: Name of the task.
    options: ``seed`` of the reset states, ``latency_s``, ``clock``.
  """
  interrupts.leave_to_the_main_process()
  board = Blackboard(name, RECORDS)
  try:
    tasks = importlib.import_module("apnpql_jax.tasks")
    task = tasks.make_task(task_name)
    servo = Servo(latency_s=options["latency_s"])
    plant = Plant(task.scene.model, servo, seed=options["seed"])
    scene = Scene(task, seed=options["seed"])
    _run(Simulation(board, plant, scene), options["clock"])
  except Exception as error:  # Shown by the main process, which ends the session.
    with contextlib.suppress(Exception):
      board["plant"].write({"error": reason(error)})
  finally:
    board.close()


class Simulation:
  """A plant behind its board."""

  def __init__(self, board: Blackboard, plant: Plant, scene: Scene):
    """Keeps them, and parks the arm; ``scene`` places the objects."""
    self._board, self._plant, self._scene = board, plant, scene
    self._shown = self._parked = self._zeroed = self._variant = 0
    self._since = 0.0
    scene.park(plant)

  def obey(self, now: float) -> bool:
    """Places objects and arm and zeroes the sensor; returns whether to go on."""
    order, servo = self._board["scene"].read(), self._board["servo"].read()
    if order["number"] != self._shown:
      self._variant = self._scene.place(self._plant)
      self._shown, self._since = int(order["number"]), now
    if order["parked"] != self._parked:
      self._parked = int(order["parked"])
      self._scene.park(self._plant)
    if servo["zero"] != self._zeroed:
      self._zeroed = int(servo["zero"])
      self._plant.zero_force()
    return not order["quit"]

  def step(self) -> None:
    """Advances by 2 ms under the present commands to arm and gripper."""
    servo, grip = self._board["servo"].read(), self._board["grip"].read()["command"]
    target = servo["target"] if servo["follow"] else None
    self._plant.step(target, None if grip == HOLD else bool(grip == CLOSE))

  def publish(self, now: float) -> None:
    """Writes the state of the plant."""
    state = self._plant.arm_state(now)
    self._board["plant"].write(
      {
        "ready": 1,
        "scene": self._shown if now - self._since > _SETTLE_S else 0,
        "parked": self._parked,
        "time": state.time,
        "position": state.position,
        "velocity": state.velocity,
        "wrench": state.wrench,
        "gripper": self._plant.gripper_angle,
        "zeroed": self._zeroed,
        "variant": self._variant,
        **self._scene.state_of(self._plant),
      }
    )


def _run(simulation: Simulation, clock: Clock) -> None:
  parent, due = parent_process(), clock.now()
  while (parent is None or parent.is_alive()) and simulation.obey(clock.now()):
    while due <= clock.now():
      simulation.step()
      due = max(due + TIMESTEP, clock.now() - _CATCH_UP_S)
    simulation.publish(clock.now())
    clock.sleep(due - clock.now())
