"""Both cameras of the simulated robot: the ray caster that the policy was trained with.

They run in the policy process, because the ray caster needs JAX. A frame is drawn when
it is asked for, from the newest state of the plant.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.config import files
from apnpql_jax.data.lerobot import conversion
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.robot.blackboard import Blackboard
from apnpql_jax.robot.protocols import CAMERAS, Frame
from apnpql_jax.robot.simulated.process import RECORDS
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.sim.physics import PhysicsState
from apnpql_jax.tasks import make_task


class View:
  """The task's scene as the plant has it, drawn and judged in JAX.

  See ``protocols.Judge``.
  """

  def __init__(self, plant: str, contract: dict[str, Any]):
    """Compiles the cameras of the contract."""
    self.task = make_task(contract["task"])
    sizes = {
      f"{name}_size": (view["height"], view["width"])
      for name, view in contract["cameras"].items()
    }
    config = dataclasses.replace(files.task_env(contract["task"]), **sizes)
    kinematics = make_kinematics(self.task.scene)
    cameras = make_cameras(config, self.task.scene)

    @jax.jit
    def draw(state: PhysicsState) -> tuple[jax.Array, ...]:
      poses = kinematics(state)
      images = [camera(poses)[0] for camera in cameras]
      return *images, self.task.success(state, poses)[0]

    self._draw = draw
    self._board = Blackboard(plant, RECORDS)
    self.frames: list[Frame] = []
    self._solved, self._environment = False, np.zeros(0, np.float32)

  def look(self) -> None:
    """Draws both cameras, judges whether the task is solved, and keeps the state."""
    found = self._board["plant"].read()
    state = state_of(self.task, found)
    *images, solved = jax.device_get(self._draw(state))
    arrays = state.qpos, state.qvel, state.mocap_pos, state.mocap_quat
    variant = np.array([found["variant"]])
    (self._environment,) = conversion.states(*map(np.asarray, arrays), variant)
    time = float(found["time"])
    self.frames = [Frame(time, np.asarray(image)) for image in images]
    self._solved = bool(solved)

  def solved(self) -> bool:
    """See ``Judge.solved``."""
    return self._solved

  def environment(self) -> np.ndarray:
    """See ``Judge.environment``."""
    return self._environment

  def environment_names(self) -> list[str]:
    """See ``Judge.environment_names``."""
    return conversion.state_names(self.task.scene)

  def close(self) -> None:
    """Lets go of the plant."""
    self._board.close()


def state_of(task: Any, found: Any) -> PhysicsState:
  """Returns a record "plant" as the state of one world."""
  model = task.scene.model

  def array(name: str, *shape: int) -> jax.Array:
    return jnp.asarray(found[name][: int(np.prod(shape))].reshape(1, *shape), "f4")

  state = physics.initial_state(
    task.scene,
    array("qpos", model.nq),
    array("mocap_pos", model.nmocap, 3),
    array("mocap_quat", model.nmocap, 4),
    jnp.asarray([int(found["variant"])]),
  )
  return state.replace(qvel=array("qvel", model.nv))


class SimulatedCamera:
  """A simulated ``protocols.Camera``; the first one draws for both."""

  def __init__(self, view: View, index: int):
    """Keeps the view; ``index`` is that of ``CAMERAS``."""
    self._view, self._index = view, index

  def connect(self) -> None:
    """See ``Device.connect``."""

  def disconnect(self) -> None:
    """See ``Device.disconnect``."""
    if not self._index:
      self._view.close()

  def describe(self) -> dict[str, Any]:
    """See ``Device.describe``."""
    return {"model": f"simulated {CAMERAS[self._index]} camera"}

  def get_observation(self) -> Frame:
    """See ``Camera.get_observation``."""
    if not self._index:
      self._view.look()
    return self._view.frames[self._index]


def make(plant: str, contract: dict[str, Any]) -> tuple[list[SimulatedCamera], View]:
  """Returns the cameras in the order of ``CAMERAS``, and what judges their scene."""
  view = View(plant, contract)
  return [SimulatedCamera(view, index) for index in range(len(CAMERAS))], view
