"""Parts of a control period, each as a program that is timed alone.

They are physics, rendering and networks (the policy encodes, draws candidates and picks
one). The rest is what an environment or an iteration takes beyond its parts.
"""

from collections.abc import Callable, Mapping
import copy
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray
import mujoco

from apnpql_jax.agents.learner import Agent
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.envs.env import Env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.sim.mjx import MjxPhysics
from apnpql_jax.sim.physics import Physics, PhysicsState
from apnpql_jax.tasks.contact_report import SUBSTEPS
from apnpql_jax.training.rollout import agent_policy
from apnpql_jax.types import ARM_DOF, Array
from benchmarks.common import floor, timing

PLAYED = 5  # rollouts before anything is timed: nothing moves yet at the reset

Part = tuple[float, float]  # seconds and floor of a part, for all worlds


def random_policy(state: EnvState, key: PRNGKeyArray) -> tuple[Array, Array]:
  """Draws random actions; a ``rollout.WorldPolicy``."""
  worlds = state.elapsed.shape[0]
  return random_actions(key, worlds), jnp.zeros(worlds)


def random_actions(key: PRNGKeyArray, worlds: int) -> Array:
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
  moving = (state.physics, action[:, :ARM_DOF], action[:, ARM_DOF])
  work = physics_work(env.physics, state.physics)
  found = {"physics": _ready(env.physics.step, moving, work)}
  if env.config.obs == "pixels":
    images = functools.partial(draw, env, env.config)
    found["rendering"] = _ready(images, (state.physics,))

  def act(params: Any, state: EnvState, key: PRNGKeyArray) -> tuple[Array, Array]:
    return agent_policy(agent, params, acting="policy")(state, key)

  return found | {"networks": _ready(act, (params, state, jax.random.key(0)))}


def _ready(
  function: Callable[..., Any], args: tuple[Any, ...], work: floor.Work | None = None
) -> timing.Ready:
  run, _ = timing.compiled(jax.jit(function), *args)
  floor_s = (work or floor.count(function, *args)).seconds()
  return timing.Ready(functools.partial(run, *args), floor_s)


def shares(whole_s: float, parts: Mapping[str, Part]) -> dict[str, dict[str, float]]:
  """Returns the share of each part and of the rest, for a report.

  If the parts add up to more than the whole, shares are of their sum, without a rest.
  """
  total_s = max(whole_s, sum(seconds for seconds, _ in parts.values()))
  found = {
    name: {"share": s / total_s, "seconds": s, **floor.compare(floor_s, s)}
    for name, (s, floor_s) in parts.items()
  }
  rest = total_s - sum(seconds for seconds, _ in parts.values())
  return found | {"rest": {"share": rest / total_s}}


def physics_work(engine: Physics, state: PhysicsState) -> floor.Work:
  """Counts the work of one control period of all worlds.

  Operations of C MuJoCo cannot be counted. Those of MJX without contacts replace them,
  because C MuJoCo computes only the contacts that occur.
  """
  scene = engine.scene
  if engine.name != "mjx":
    model = copy.copy(scene.model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    # Without contacts both cones are the same, but MJX refuses the elliptic one.
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    scene = dataclasses.replace(scene, model=model)
  world = jax.tree.map(lambda x: x[:1], state)
  step = MjxPhysics(scene, substeps=1).step
  one = floor.count(step, world, jnp.zeros((1, ARM_DOF)), jnp.zeros(1))
  flops = SUBSTEPS * len(state.time) * one.flops
  return floor.Work(flops, 2 * floor.nbytes(state))
