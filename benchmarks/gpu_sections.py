"""The sections of gpu_suite.py, each run in a process of its own.

  python benchmarks/gpu_sections.py SECTION SETTINGS

A section says first what it is going to measure, see ``gpu_measure``.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
import json
from pathlib import Path
import sys
from typing import Any

import apnpql_jax  # isort: skip  (before JAX: sets threads and cache)
from cures import cures
from gpu_measure import Item, Settings, emit, measure_all
import gpu_training
import jax
import jax.numpy as jnp
from learner import nth_update
import mujoco
from mujoco import mjx
import mujoco.rollout
import numpy as np
from parts import random_policy
from ray_layouts import LAYOUTS, SIZES, Layout
from render import make_pair, make_poses

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.tasks import make_task
from apnpql_jax.training.expert import empty_expert
from apnpql_jax.training.iteration import make_iteration
from apnpql_jax.training.rollout import agent_policy, rollout
from apnpql_jax.training.state import initial_state
from apnpql_jax.types import Array, Transition

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from apnpql_jax.testing import random_batch

PRECISIONS = ("highest", "tensorfloat32")


def device(settings: Settings) -> None:
  """What the device can do: matrix products by precision, and moving memory."""
  stats = jax.local_devices()[0].memory_stats() or {}
  emit(
    what="device",
    kind=jax.devices()[0].device_kind,
    backend=jax.default_backend(),
    versions={m.__name__: m.__version__ for m in (jax, apnpql_jax)},
    memory_gib=stats.get("bytes_limit", 0) / 2**30,
  )
  size = settings["matrix"]
  matrix = jnp.ones((size, size))

  def product(precision: str, dtype: Any) -> Callable[[], Any]:
    def lower() -> Any:
      with jax.default_matmul_precision(precision):
        return jax.jit(jnp.dot).lower(matrix.astype(dtype), matrix.astype(dtype))

    return lower

  tera = 2 * size**3 / 1e12
  kinds = {"float32": "highest", "tf32": "tensorfloat32", "bfloat16": "bfloat16"}
  items = []
  for name, precision in kinds.items():
    dtype = jnp.bfloat16 if name == "bfloat16" else jnp.float32
    pair = functools.partial(lambda dtype: (matrix.astype(dtype),) * 2, dtype)
    items.append(
      Item(f"product {name}", product(precision, dtype), pair, tera, "teraflop")
    )
  flat = matrix.reshape(-1)
  copy = functools.partial(jax.jit(lambda x: x + 1.0).lower, flat)
  giga = 2 * flat.nbytes / 2**30
  items.append(Item("copy", copy, lambda: (flat,), giga, "gib"))
  measure_all(items, settings)


def engines(settings: Settings) -> None:
  """A control period of plain ``mjx.step`` on push_plate: cures, precision, contacts
  without the scene's limit, Warp.

  Each final state is compared with that of C MuJoCo.
  """
  count = settings["engine_worlds"]
  task, substeps = make_task("push_plate"), settings["substeps"]
  limited, unlimited = task.scene.model, make_task("push_plate").scene.model
  unlimited.numeric("max_contact_points").data[:] = -1
  draw = task.sample_resets(np.random.default_rng(0), count)
  qpos = jnp.asarray(draw.qpos, jnp.float32)
  expected = native_period(limited, draw.qpos, substeps)

  def lower(
    impl: str,
    barrier: bool,
    cones: bool,
    precision: str = "highest",
    model: mujoco.MjModel = limited,
  ) -> Any:
    kept = mjx.make_data(unlimited, impl="jax")._impl  # Warp knows of no limit.
    sizes = {"naconmax": count * kept.ncon, "njmax": kept.nefc}
    put = mjx.put_model(model, impl=impl)
    data = mjx.make_data(model, impl=impl, **(sizes if impl == "warp" else {}))

    def period(qpos: Array) -> Array:
      def step(worlds: Any, _: None) -> tuple[Any, None]:
        # Warp knows its worlds as a batch: the scan must be around them.
        return jax.vmap(mjx.step, in_axes=(None, 0))(put, worlds), None

      worlds = jax.vmap(lambda qpos: data.replace(qpos=qpos))(qpos)
      return jax.lax.scan(step, worlds, None, length=substeps)[0].qpos

    chosen = cures(barrier=barrier, cones=cones)
    with chosen, jax.default_matmul_precision(precision):
      return jax.jit(period).lower(qpos)

  def differs(qpos: Array) -> dict[str, Any]:
    finite = bool(jnp.isfinite(qpos).all())
    return {"finite": finite, "qpos_differs": float(np.abs(qpos - expected).max())}

  variants = {
    "jax, cones": ("jax", False, True),
    "jax, cones, all contacts": ("jax", False, True, "highest", unlimited),
    "jax, barrier and cones": ("jax", True, True),
    "jax, barrier": ("jax", True, False),
    "jax, stock": ("jax", False, False),
    "jax, cones, TF32": ("jax", False, True, "tensorfloat32"),
    "warp": ("warp", False, False),
  }
  measure_all(
    (
      Item(
        name,
        functools.partial(lower, *variants[name]),
        lambda: (qpos,),
        count,
        look=differs,
      )
      for name in settings["engines"]
    ),
    settings,
  )


def native_period(model: mujoco.MjModel, qpos: np.ndarray, steps: int) -> np.ndarray:
  """f64[worlds, nq]: where C MuJoCo comes to from rest at ``qpos`` in some steps."""
  kind, data = mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.MjData(model)
  starts = np.empty((len(qpos), mujoco.mj_stateSize(model, kind)))
  for world, start in zip(qpos, starts, strict=True):
    data.qpos[:] = world
    mujoco.mj_getState(model, data, start, kind)
  states, _ = mujoco.rollout.rollout(model, data, starts, nstep=steps)
  return states[:, -1, 1 : 1 + model.nq]  # Behind the time.


def raycaster(settings: Settings) -> None:
  """Pairs of images by the layout of the work, and with shadows."""
  count, scene = settings["render_worlds"], make_task("push_plate").scene
  seen = make_poses(scene, count)
  pairs = {name: LAYOUTS[name].pair(scene) for name in settings["layouts"]}
  pairs["shadows"] = make_pair(scene, SIZES, shadow=True)

  def lower(name: str) -> Any:
    with LAYOUTS.get(name, Layout()).traced():
      return jax.jit(pairs[name]).lower(seen)

  measure_all(
    (
      Item(name, functools.partial(lower, name), lambda: (seen,), count, "pairs")
      for name in pairs
    ),
    settings,
  )


def learner(settings: Settings) -> None:
  """Updates per second by batch and precision of matrix products."""
  agent = make_agent(gpu_training.agent_config(settings))
  updates = settings["updates"]

  def many(state: Any, batch: Transition) -> Any:
    update = functools.partial(nth_update, agent, batch)
    return jax.lax.fori_loop(0, updates, update, state)

  def args(size: int) -> tuple[Any, ...]:
    batch = random_batch(0, size, pixels=True)
    return agent.init(jax.random.key(0), batch.observation_tm1), batch

  def lower(size: int, precision: str) -> Any:
    with jax.default_matmul_precision(precision):
      return jax.jit(many).lower(*args(size))

  measure_all(
    (
      Item(
        f"batch {size}, {precision}",
        functools.partial(lower, size, precision),
        functools.partial(args, size),
        updates,
        "updates",
      )
      for size in settings["batches"]
      for precision in PRECISIONS
    ),
    settings,
  )


def worlds(settings: Settings) -> None:
  """Environment steps with both cameras of one task, by the number of worlds."""
  config = EnvConfig(
    task=settings["task"], backend=settings["backend"], bank_rows=settings["bank_rows"]
  )
  env = make_env(config)

  def step(carry: tuple[EnvState, Array]) -> tuple[tuple[EnvState, Array], None]:
    key, play_key = jax.random.split(carry[1])
    state, _ = rollout(env, random_policy, carry[0], play_key, length=1)
    return (state, key), None

  def start(rows: Array) -> tuple[EnvState, Array]:
    return env.reset(rows), jax.random.key(0)

  def args(count: int) -> tuple[Any]:
    return (jax.jit(start)(jnp.arange(count) % env.bank_split),)

  def lower(count: int) -> Any:
    carry = jax.eval_shape(start, jax.ShapeDtypeStruct((count,), jnp.int32))
    return jax.jit(step, donate_argnums=0).lower(carry)

  measure_all(
    (
      Item(
        f"{count} worlds",
        functools.partial(lower, count),
        functools.partial(args, count),
        count,
        carry=True,
      )
      for count in settings["worlds"]
    ),
    settings,
  )


def rates(settings: Settings) -> None:
  """The policy alone, environment with policy, and a whole iteration."""
  count = settings["rate_worlds"]
  config = gpu_training.training_config(settings, count)
  env, agent = make_env(config.env), make_agent(config.agent)
  # An expert's replay that is empty is sampled at the same cost.
  state = initial_state(config, env, agent, empty_expert)
  iteration: Any = make_iteration(config, env, agent)
  steps = config.rollout_length * count

  def play(state: EnvState, params: Any, key: Array) -> tuple[EnvState, Array]:
    policy = agent_policy(agent, params, greedy=False)
    return rollout(env, policy, state, key, length=config.rollout_length)[0], key

  def act(params: Any, observation: Any, key: Array) -> Array:
    return agent.act(params, observation, key, False)[0]

  key = jax.random.key(0)
  # Copies, because the iteration is given the state itself and takes it apart.
  params, begun = jax.tree.map(jnp.copy, (state.learner.params, state.env))
  acting, playing = (params, begun.timestep.observation, key), (begun, params, key)
  items = [
    Item("policy", lambda: jax.jit(act).lower(*acting), lambda: acting, count),
    Item(
      "env and policy", lambda: jax.jit(play).lower(*playing), lambda: playing, steps
    ),
    Item(
      f"env, policy and {config.updates_per_iteration} updates of batch "
      f"{config.replay.batch_size} per {steps} steps",
      lambda: iteration.lower(state),
      lambda: (state,),
      steps,
      carry=True,
    ),
  ]
  measure_all(items, settings)


SECTIONS = {
  "device": device,
  "engines": engines,
  "raycaster": raycaster,
  "learner": learner,
  "worlds": worlds,
  "rates": rates,
  "train": gpu_training.train,
}


if __name__ == "__main__":
  # Without arguments it has been found that all imports are there.
  if len(sys.argv) > 1:
    SECTIONS[sys.argv[1]](json.loads(sys.argv[2]))
