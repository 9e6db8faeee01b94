"""Joint targets that stay fixed, found by playing episodes (``env.static_targets``).

The paper's primitives lead straight to configurations at the object, at the goal and at
rest (Sec. IV-A and V-A). The primitives of the tasks here pass waypoints that depend on
where the hand is, so a reset state does not tell where they end.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PRNGKeyArray
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.console import print_line
from apnpql_jax.envs.state import EnvState, where_world
from apnpql_jax.primitives.reset_bank import ResetBank
from apnpql_jax.tasks import Task
from apnpql_jax.types import ARM_DOF, PRIMITIVES, Array

AT_ONCE = 256  # worlds
REACH_PERIODS = 40  # control periods in which the hand comes to rest at the object

Policy = Callable[[EnvState], tuple[Array, Array]]
"""State -> actions f32[worlds, 7], and whether they count bool[worlds]."""


class Worlds(Protocol):
  """The parts of ``Env`` that are needed to play."""

  config: EnvConfig
  task: Task

  def reset(self, rows: Array) -> EnvState:
    """See ``Env``."""
    ...

  def step(self, state: EnvState, action: Array, key: PRNGKeyArray) -> EnvState:
    """See ``Env``."""
    ...

  def expert_action(self, state: EnvState) -> Array:
    """See ``Env``."""
    ...


def with_static_targets(bank: ResetBank, env: Worlds) -> ResetBank:
  """Returns the bank with targets at the ends of the primitives.

  At the object, it is where the object primitive alone comes to rest. At the goal, it
  is where the scripted expert begins to open the hand, or where its episode ends if it
  does not open it. Plays two episodes per row, which takes minutes for thousands of
  rows.

  Args:
    bank: Reset states.
    env: Worlds of the bank whose primitives track the scene.
  """
  print_line(f"playing from {bank.rows:,} reset states for the static targets")
  reach, solve = PRIMITIVES.index("object"), PRIMITIVES.index("goal")

  def reaching(state: EnvState) -> tuple[Array, Array]:
    return state.timestep.primitives[:, reach], jnp.ones_like(state.timestep.last)

  def solving(state: EnvState) -> tuple[Array, Array]:
    close = state.timestep.primitives[:, solve, ARM_DOF] > 0.5
    return env.expert_action(state), close

  @jax.jit
  def ends(rows: Int[Array, " worlds"]) -> Float[Array, "worlds 2 6"]:
    found = (
      _end(env, rows, reaching, REACH_PERIODS),
      _end(env, rows, solving, env.config.episode_steps),
    )
    return jnp.stack(found, axis=1)

  starts = range(0, bank.rows, AT_ONCE)
  last = bank.rows - 1
  found = [ends((start + jnp.arange(AT_ONCE)).clip(max=last)) for start in starts]
  played = jnp.concatenate(found)[: bank.rows]
  targets = bank.targets.at[:, np.array([reach, solve])].set(played)
  return bank.replace(targets=targets)


def _end(
  env: Worlds, rows: Int[Array, " worlds"], policy: Policy, periods: int
) -> Float[Array, "worlds 6"]:
  """Plays until episodes end or for a time.

  Returns:
    The joint angles (rad) after the last action that counts.
  """
  joints, key = env.task.scene.arm_qpos, jax.random.key(0)

  def period(carry: tuple[EnvState, Array, Array]) -> tuple[EnvState, Array, Array]:
    state, q, over = carry
    action, counts = policy(state)
    state = env.step(state, action, key)
    over |= state.elapsed == 0  # A broken world has begun another episode.
    q = where_world(counts & ~over, state.physics.qpos[:, joints], q)
    over |= state.timestep.last | (state.elapsed >= periods)
    return state, q, over

  state = env.reset(rows)
  first = state, state.physics.qpos[:, joints], jnp.zeros(len(rows), bool)
  return jax.lax.while_loop(lambda carry: ~carry[2].all(), period, first)[1]
