"""Parts of a control period, each as a program that is timed alone.

They are physics, rendering and networks (the policy encodes, draws candidates and picks
one). The rest is what an environment or an iteration takes beyond its parts.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from apnpql_jax.agents.learner import Agent
from apnpql_jax.cameras import make_cameras
from apnpql_jax.config import EnvConfig
from apnpql_jax.contact_report import SUBSTEPS
from apnpql_jax.env import Env
from apnpql_jax.env_state import EnvState
from apnpql_jax.rollout import agent_policy
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.sim.physics import Physics, PhysicsState
from apnpql_jax.types import ARM_DOF, Array
from benchmarks.common import floor, timing

PLAYED = 5
"""Rollouts before anything is timed: nothing moves yet at the reset."""

_substep_flops: dict[tuple[str, bool], float] = {}
"""Operations of one world, by fingerprint of the scene and whether contacts count."""


class Part(NamedTuple):
  """Duration of a part of a control period or of an iteration, for all worlds."""

  seconds: float
  floor_s: float


def random_policy(state: EnvState, key: Array) -> tuple[Array, Array]:
  """Draws random actions; a ``rollout.Policy``."""
  worlds = state.elapsed.shape[0]
  return random_actions(key, worlds), jnp.zeros(worlds)


def random_actions(key: Array, worlds: int) -> Array:
  """Draws f32[worlds, 7], uniform over the action box."""
  arm_key, grip_key = jax.random.split(key)
  velocity = jax.random.uniform(arm_key, (worlds, ARM_DOF), minval=-1.0, maxval=1.0)
  close = jax.random.bernoulli(grip_key, shape=(worlds, 1)).astype(jnp.float32)
  return jnp.concatenate([velocity, close], axis=-1)


def draw(env: Env, config: EnvConfig, physics: PhysicsState) -> list[Array]:
  """Renders both images of all worlds, in the sizes of ``config``."""
  return [env.view(camera, physics) for camera in make_cameras(config, env.task.scene)]


def prepare(
  env: Env, agent: Agent, params: Any, state: EnvState
) -> dict[str, timing.Ready]:
  """Compiles the parts of a control period from ``state``, for all worlds."""
  action = random_actions(jax.random.key(0), state.elapsed.shape[0])
  velocity, close = action[:, :ARM_DOF], action[:, ARM_DOF]
  moving = (state.physics, velocity, close)
  work = physics_work(env.physics, state.physics)
  found = {"physics": _ready(env.physics.step, moving, work)}
  if env.config.obs == "pixels":
    images = functools.partial(draw, env, env.config)
    found["rendering"] = _ready(images, (state.physics,))

  def act(params: Any, state: EnvState, key: Array) -> tuple[Array, Array]:
    return agent_policy(agent, params, greedy=False)(state, key)

  return found | {"networks": _ready(act, (params, state, jax.random.key(0)))}


def _ready(
  function: Callable[..., Any], args: tuple[Any, ...], work: floor.Work | None = None
) -> timing.Ready:
  run, _ = timing.compiled(jax.jit(function), *args)
  floor_s = (work or floor.count(function, *args)).seconds()
  return timing.Ready(functools.partial(run, *args), floor_s)


def shares(whole_s: float, parts: dict[str, Part]) -> dict[str, dict[str, float]]:
  """Returns the share of each part and of the rest, for a report.

  Parts may add up to more than the whole. Then their sum is the whole, and the rest is
  zero.
  """
  sum_s = sum(part.seconds for part in parts.values())
  total_s = max(whole_s, sum_s)
  found = {
    name: {
      "share": part.seconds / total_s,
      "seconds": part.seconds,
      **floor.compare(part.floor_s, part.seconds),
    }
    for name, part in parts.items()
  }
  return found | {"rest": {"share": (total_s - sum_s) / total_s}}


def physics_work(engine: Physics, state: PhysicsState) -> floor.Work:
  """Counts the work of one control period of all worlds.

  Operations of C MuJoCo cannot be counted. Those of MJX without contacts replace them,
  because C MuJoCo computes only the contacts that occur.
  """
  scene, contacts = engine.scene, engine.name == "mjx"
  if (known := (scene.fingerprint, contacts)) not in _substep_flops:
    if not contacts:
      model = copy.copy(scene.model)
      model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
      # Without contacts both cones are the same, but MJX refuses the elliptic one.
      model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
      scene = dataclasses.replace(scene, model=model)
    world = jax.tree.map(lambda x: x[:1], state)
    step = MjxPhysics(scene, substeps=1).step
    one = floor.count(step, world, jnp.zeros((1, ARM_DOF)), jnp.zeros(1))
    _substep_flops[known] = one.flops
  flops = SUBSTEPS * len(state.time) * _substep_flops[known]
  return floor.Work(flops, 2 * floor.nbytes(state))
