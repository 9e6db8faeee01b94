"""The scripted expert solves tasks through the core and the position-controlled plant.

In lockstep, so that the result does not depend on the load of the machine.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from apnpql_jax.config.files import task_env
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import Arrival, EnvState
from apnpql_jax.robot.cell import Cell
from apnpql_jax.robot.core import Core
from apnpql_jax.robot.limits import TIMESTEP, Limits
from apnpql_jax.robot.simulated.plant import Plant, Servo
from apnpql_jax.robot.supervisor import Action, Mode

EPISODES = 10


def limits(env: Env) -> Limits:
  joints = env.task.scene.model.jnt_range[:6]
  cell = Cell()
  box = np.array([cell.workspace_low_m, cell.workspace_high_m]).T
  return Limits(box=box, joints=joints, period=env.config.control_period_s)


def observed(env: Env, state: EnvState, plant: Plant) -> EnvState:
  """Returns the next instant of a world whose physics is the plant."""
  data = plant.data
  physics = state.physics.replace(
    **{
      name: jnp.asarray(getattr(data, name), jnp.float32)[None]
      for name in ("qpos", "qvel", "mocap_pos", "mocap_quat")
    }
  )
  fresh = jnp.zeros(1, bool)
  return env.observe(Arrival.after(state, physics, state.targets, fresh))


def play(env: Env, row: int, core: Core, servo: Servo) -> tuple[bool, list[str]]:
  """Returns whether the expert solves the episode, and the reasons of all holds."""
  state = env.reset(jnp.asarray([row]))
  plant = Plant(env.task.scene.model, servo, seed=row)
  for name, values in env.task.scene.variants.items():
    variant = int(env.variant(jnp.asarray([row]))[0])
    getattr(plant.model, name)[...] = values[variant]
  start = np.asarray(state.physics.qpos[0], float)
  plant.data.qpos[:] = start
  plant.data.mocap_pos[:] = state.physics.mocap_pos[0]
  plant.data.mocap_quat[:] = state.physics.mocap_quat[0]
  plant.put_arm(start[env.task.scene.arm_qpos])
  plant.zero_force()
  choose, now, reasons = jax.jit(env.expert_action), 1.0, []
  core.start(now, plant.arm_state(now))
  for instant in range(env.config.episode_steps):
    values = np.asarray(choose(state)[0], float)
    action = Action(instant + 1, now, values, np.full(2, now))
    for _ in range(round(env.config.control_period_s / TIMESTEP)):
      command = core.step(now, plant.arm_state(now), action)
      plant.step(command.position, bool(values[6] > 0.5))
      now += TIMESTEP
      if command.mode is not Mode.FOLLOW:
        reasons.append(command.reason)
      if command.mode is Mode.STOP:
        return False, reasons
    state = observed(env, state, plant)
    if bool(state.timestep.terminated[0]):
      return True, reasons
  return False, reasons


@pytest.mark.slow
@pytest.mark.parametrize("name", ["push_plate", "stack_box"])
@pytest.mark.parametrize("admittance", [True, False])
def test_the_expert_solves_its_task(name, admittance):
  config = dataclasses.replace(
    task_env(name), obs="state", backend="native", bank_rows=256, randomize=False
  )
  env = make_env(config)
  core = Core(limits(env), admittance=Cell().admittance() if admittance else None)
  rows = range(env.bank_split, env.bank_split + EPISODES)
  found = [play(env, row, core, Servo()) for row in rows]
  print(name, admittance, found)
  assert sum(solved for solved, _ in found) >= 0.8 * EPISODES
