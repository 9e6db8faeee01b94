"""Worlds in PyBullet, for the loop of ``host_rollout.play``."""

from __future__ import annotations

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.transfer import urdf
from apnpql_jax.transfer.bullet_plant import BulletPlant
from apnpql_jax.types import Array


class BulletWorlds:
  """Worlds that PyBullet moves, with a plant for each."""

  def __init__(self, env: Env, *, latency_s: float, admittance: bool):
    """Keeps the settings; simulators are opened when they are needed.

    Raises:
      ConfigError: Bullet cannot simulate the scene, see ``urdf.check``.
    """
    urdf.check(env.task.scene)  # Before anything is compiled.
    self._stack = contextlib.ExitStack()
    self._env = env
    self._options: dict[str, Any] = {"latency_s": latency_s, "admittance": admittance}
    self.plants: list[BulletPlant] = []
    """Plants by world; ``advance`` adds them."""

  def __enter__(self) -> BulletWorlds:
    return self

  def __exit__(self, *error: object) -> None:
    """Frees the simulators."""
    self._stack.close()

  def advance(self, state: EnvState, action: Array, running: np.ndarray) -> Arrival:
    """Runs a control period of the running worlds; the others stand still.

    It takes the place of ``Env.advance``, without resets. Plants carry the state of
    servos and solver, so that they follow the worlds from their first instant on.
    """
    physics: Any = jax.tree.map(np.array, state.physics)
    commands, elapsed = np.asarray(action), np.asarray(state.elapsed)
    while len(self.plants) < len(running):
      plant = BulletPlant(self._env.task.scene, **self._options)
      self.plants.append(self._stack.enter_context(plant))
    for world in np.flatnonzero(running):
      plant = self.plants[world]
      if not elapsed[world]:
        fields = {name: x[world] for name, x in physics.fields.items()}
        poses = (x[world] for x in (physics.mocap_pos, physics.mocap_quat))
        plant.begin(physics.qpos[world], *poses, fields)
      period = self._env.config.control_period_s
      plant.step(commands[world, :6], commands[world, 6], period)
      physics.qpos[world], physics.qvel[world] = plant.bodies.state()
      physics.time[world] += period
    broken = ~np.isfinite(np.concatenate([physics.qpos, physics.qvel], 1)).all(1)
    moved = jax.tree.map(jnp.asarray, physics)
    arrival = Arrival.after(state, moved, state.targets, jnp.zeros(len(running), bool))
    return arrival.replace(faults=state.faults + broken)
