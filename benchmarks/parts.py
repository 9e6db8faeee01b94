"""What a control period consists of, each part as a program that is timed alone.

Physics, rendering and networks (the policy looks, draws candidates and picks one); what
an environment or an iteration takes beyond its parts is the rest.
"""

from __future__ import annotations

from collections.abc import Callable
import copy
import dataclasses
import functools
from typing import Any, NamedTuple

import floor
import jax
import jax.numpy as jnp
import mujoco
import timing

from apnpql_jax.agents.learner import Agent
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.envs.contact_report import SUBSTEPS
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.sim.physics import Physics, PhysicsState
from apnpql_jax.training.rollout import agent_policy
from apnpql_jax.types import ARM_DOF, Array

PLAYED = 5
"""Rollouts before anything is timed: at the reset nothing moves yet."""

_substep_flops: dict[tuple[str, bool], float] = {}
"""Of one world; by fingerprint of the scene, and whether contacts count."""


class Part(NamedTuple):
  """A part of a control period or of an iteration, of all worlds."""

  seconds: float  # measured
  floor_s: float  # the least possible


def random_policy(state: EnvState, key: Array) -> tuple[Array, Array]:
  """Random actions as a ``rollout.Policy``."""
  worlds = state.elapsed.shape[0]
  return random_actions(key, worlds), jnp.zeros(worlds)


def random_actions(key: Array, worlds: int) -> Array:
  """f32[worlds, 7], uniform over the action box."""
  arm_key, grip_key = jax.random.split(key)
  velocity = jax.random.uniform(arm_key, (worlds, ARM_DOF), minval=-1.0, maxval=1.0)
  close = jax.random.bernoulli(grip_key, shape=(worlds, 1)).astype(jnp.float32)
  return jnp.concatenate([velocity, close], axis=-1)


def draw(env: Env, config: EnvConfig, physics: PhysicsState) -> list[Array]:
  """Both images of all worlds, in the sizes of ``config``."""
  return [env.view(camera, physics) for camera in make_cameras(config, env.task.scene)]


def prepare(
  env: Env, agent: Agent, params: Any, state: EnvState
) -> dict[str, timing.Ready]:
  """The parts of a period from the instant ``state``, of all worlds."""
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

  looking = (params, state, jax.random.key(0))
  return found | {"networks": _ready(act, looking)}


def _ready(
  function: Callable[..., Any], args: tuple[Any, ...], work: floor.Work | None = None
) -> timing.Ready:
  run, _ = timing.compiled(jax.jit(function), *args)
  floor_s = (work or floor.count(function, *args)).seconds()
  return timing.Ready(functools.partial(run, *args), floor_s)


def shares(whole_s: float, parts: dict[str, Part]) -> dict[str, dict[str, float]]:
  """For the report: each part, and its share of the whole; and the share of the rest.

  Parts may add up to more than the whole, of which there is no rest then.
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
  """One control period of all worlds.

  Operations of C MuJoCo cannot be counted: those of MJX stand for them, without
  contacts, of which C MuJoCo computes only the ones that are there.
  """
  scene, contacts = engine.scene, engine.name == "mjx"
  if (known := (scene.fingerprint, contacts)) not in _substep_flops:
    if not contacts:
      model = copy.copy(scene.model)
      model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
      # Without a contact they are the same, but MJX has no elliptic cones then.
      model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
      scene = dataclasses.replace(scene, model=model)
    world = jax.tree.map(lambda x: x[:1], state)
    step = MjxPhysics(scene, substeps=1).step
    one = floor.count(step, world, jnp.zeros((1, ARM_DOF)), jnp.zeros(1))
    _substep_flops[known] = one.flops
  flops = SUBSTEPS * len(state.time) * _substep_flops[known]
  return floor.Work(flops, 2 * floor.nbytes(state))
