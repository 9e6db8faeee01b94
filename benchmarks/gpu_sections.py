"""The sections of gpu_suite.py, each run in a process of its own.

A section first says what it is going to measure and then prints one line of JSON per
figure, so that nothing measured is lost when its time is over. Its programs compile in
threads, beside those of other sections; measurements come one at a time, and wait for
the compilations up to a moment that the suite sets ("quiet" tells whether they did).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
import concurrent.futures
import contextlib
import dataclasses
import fcntl
import functools
import json
from pathlib import Path
import statistics
import sys
import threading
import time
from typing import Any
from unittest import mock

import apnpql_jax  # isort: skip  (before JAX: sets threads and cache)
from cures import cures
import jax
import jax.numpy as jnp
from mujoco import mjx
import numpy as np
from peer_ours import random_policy

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.cameras import make_cameras
from apnpql_jax.config import AgentConfig, EnvConfig, TrainConfig
from apnpql_jax.env import EnvState, make_env
from apnpql_jax.evaluate import make_player, play_held_out
from apnpql_jax.iteration import (
  collect_expert,
  empty_expert,
  initial_state,
  make_iteration,
)
from apnpql_jax.presets import load_preset
from apnpql_jax.render import raycast
from apnpql_jax.rollout import agent_policy, rollout
from apnpql_jax.sim import physics
from apnpql_jax.sim.kinematics import make_kinematics
from apnpql_jax.tasks import make_task
from apnpql_jax.types import Array, Transition

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from batches import random_batch  # noqa: E402  (the noise that the tests use)

Settings = dict[str, Any]
PRECISIONS = ("highest", "tensorfloat32")
SLOW_S = 5.0
"""A repeat that takes longer is the only one."""


@dataclasses.dataclass(frozen=True)
class Item:
  """One figure of a section."""

  what: str

  lower: Callable[[], Any]
  """Traces; returns what has a method ``compile``. One thread at a time."""

  args: Callable[[], tuple[Any, ...]]
  """Arguments of the program."""

  per_call: float
  """Units of a call; the figure is units per second."""

  unit: str = "steps"

  look: Callable[[Any], dict[str, Any]] = lambda _: {}
  """What else is to be told of the program's output."""

  carry: bool = False
  """The program donates its first argument and returns its successor first."""


def emit(**line: Any) -> None:
  """One line of the report."""
  print(json.dumps(line), flush=True)


def measure_all(items: Iterable[Item], settings: Settings) -> None:
  """Compiles all items, measures each when it is ready, and reports as it goes."""
  items = list(items)
  emit(plan=[item.what for item in items])
  tracing = threading.Lock()

  def build(item: Item) -> tuple[Any, Any, dict[str, float]]:
    with _lock(settings, "compile", shared=True):
      with tracing:
        began = time.perf_counter()
        lowered = item.lower()
        traced = time.perf_counter()
      program = lowered.compile()
      seconds = {"trace_s": traced - began, "compile_s": time.perf_counter() - traced}
      return program, item.args(), seconds

  with concurrent.futures.ThreadPoolExecutor(settings["threads"]) as pool:
    futures = {pool.submit(build, item): item for item in items}
    for future in concurrent.futures.as_completed(futures):
      item = futures[future]
      try:
        program, args, seconds = future.result()
        with measuring(settings) as quiet:
          figures = _measure(item, program, list(args), settings)
        emit(what=item.what, quiet=quiet, **seconds, **figures)
      except Exception as error:  # One figure must not cost the others.
        reason = (str(error).splitlines() or [""])[0][:300]
        emit(what=item.what, error=f"{type(error).__name__}: {reason}")


def _measure(
  item: Item, program: Any, args: list[Any], settings: Settings
) -> dict[str, Any]:
  rates = []
  for repeat in range(1 + settings["repeats"]):
    calls, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < settings["seconds"] or not calls:
      out = jax.block_until_ready(program(*args))
      if item.carry:
        args[0] = out[0]
      calls += 1
    if repeat or spent > SLOW_S:  # The first calls are slower than those that follow.
      rates.append(calls * item.per_call / spent)
    if spent > SLOW_S:
      break
  name = f"{item.unit}_per_s"
  figures = {
    name: statistics.median(rates),
    f"{name}_low": min(rates),
    f"{name}_high": max(rates),
  }
  return figures | item.look(out) | memory(program)


def memory(program: Any) -> dict[str, float]:
  """GiB of a program's arrays, and the most that the process has held on the device."""
  found = {}
  if (sizes := program.memory_analysis()) is not None:
    bytes_ = sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    found["program_gib"] = (bytes_ + sizes.temp_size_in_bytes) / 2**30
  stats = jax.local_devices()[0].memory_stats() or {}
  if "peak_bytes_in_use" in stats:
    found["peak_gib"] = stats["peak_bytes_in_use"] / 2**30
  return found


@contextlib.contextmanager
def measuring(settings: Settings) -> Generator[bool, None, None]:
  """The device for oneself; true if nobody compiles meanwhile."""
  with _lock(settings, "compile", until=settings["compile_until"]) as quiet:
    with _lock(settings, "device"):
      yield quiet


@contextlib.contextmanager
def _lock(
  settings: Settings, name: str, *, shared: bool = False, until: float | None = None
) -> Generator[bool, None, None]:
  """A lock between processes and threads; false if it was not free ``until`` then."""
  kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
  with (Path(settings["folder"]) / name).open("w") as file:
    while True:
      try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
      except BlockingIOError:
        if until is not None and time.time() > until:
          yield False
          return
        time.sleep(0.05)
        continue
      yield True
      return


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
  """A control period of plain ``mjx.step`` on push_plate: cures, precision, Warp.

  Each final state is compared with that of the variant that was measured first.
  """
  count, reference = settings["engine_worlds"], {}
  task, substeps = make_task("push_plate"), settings["substeps"]
  model = task.scene.model
  draw = task.sample_resets(np.random.default_rng(0), count)
  qpos = jnp.asarray(draw.qpos, jnp.float32)

  def lower(impl: str, barrier: bool, cones: bool, precision: str) -> Any:
    kept = mjx.make_data(model, impl="jax")._impl
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
    first = reference.setdefault("qpos", np.asarray(qpos))
    return {"finite": finite, "qpos_differs": float(np.abs(qpos - first).max())}

  variants = {
    "jax, cones": ("jax", False, True, "highest"),
    "jax, barrier and cones": ("jax", True, True, "highest"),
    "jax, barrier": ("jax", True, False, "highest"),
    "jax, stock": ("jax", False, False, "highest"),
    "jax, cones, TF32": ("jax", False, True, "tensorfloat32"),
    "warp": ("warp", False, False, "highest"),
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


def raycaster(settings: Settings) -> None:
  """Pairs of images by the layout of the pixels, with shadows and with textures."""
  count, task = settings["render_worlds"], make_task("push_plate")
  draw = task.sample_resets(np.random.default_rng(0), count)
  state = physics.initial_state(task.scene, *map(jnp.asarray, draw))
  seen = jax.jit(make_kinematics(task.scene))(state)

  def lower(blocks: int, shadows: bool) -> Any:
    cameras = make_cameras(EnvConfig(shadows=shadows), task.scene)
    with mock.patch.object(raycast, "BLOCKS", blocks):
      return jax.jit(lambda poses: [camera(poses) for camera in cameras]).lower(seen)

  variants = {f"{n} blocks": (n, False) for n in settings["blocks"]}
  variants["shadows"] = (raycast.BLOCKS, True)
  measure_all(
    (
      Item(name, functools.partial(lower, *variant), lambda: (seen,), count, "pairs")
      for name, variant in variants.items()
    ),
    settings,
  )


def learner(settings: Settings) -> None:
  """Updates per second by batch and precision of matrix products."""
  agent = make_agent(agent_config(settings))
  updates = settings["updates"]

  def many(state: Any, batch: Transition, key: Array) -> tuple[Any, Array]:
    def one(state: Any, key: Array) -> tuple[Any, Array]:
      state, metrics = agent.update(state, batch, key)
      return state, metrics["loss/q"]

    return jax.lax.scan(one, state, jax.random.split(key, updates))

  def args(size: int) -> tuple[Any, ...]:
    batch = random_batch(0, size, pixels=True)
    state = agent.init(jax.random.key(0), batch.observation_tm1)
    return state, batch, jax.random.key(1)

  def lower(size: int, precision: str) -> Any:
    # A function of its own, for what has been traced once is not traced again.
    run = functools.partial(many)
    with jax.default_matmul_precision(precision):
      return jax.jit(run).lower(*args(size))

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


def agent_config(settings: Settings) -> AgentConfig:
  """The preset's agent with the candidates asked for."""
  config = load_preset("push_plate").agent
  return dataclasses.replace(
    config,
    target_samples=settings["candidates"],
    policy_samples=settings["candidates"],
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


def gpu_config(settings: Settings, worlds: int) -> TrainConfig:
  """The preset of push_plate for a GPU: more worlds, a batch that grows with them.

  As on a CPU, updates see 16 transitions for every environment step.
  """
  base, batch = load_preset("push_plate"), settings["train_batch"]
  steps = base.rollout_length * worlds
  share = base.updates_per_iteration * base.replay.batch_size
  share = share / (base.rollout_length * base.env.worlds)
  return dataclasses.replace(
    base,
    env=dataclasses.replace(
      base.env,
      backend=settings["backend"],
      worlds=worlds,
      bank_rows=settings["bank_rows"],
    ),
    agent=agent_config(settings),
    replay=dataclasses.replace(
      base.replay,
      batch_size=batch,
      capacity=settings["replay_periods"] * worlds,
      expert_steps=settings["expert_periods"] * worlds,
    ),
    updates_per_iteration=max(1, round(share * steps / batch)),
  )


def rates(settings: Settings) -> None:
  """The policy alone, environment with policy, and a whole iteration."""
  count = settings["rate_worlds"]
  config = gpu_config(settings, count)
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


def train(settings: Settings) -> None:
  """Trains on push_plate from pixels for some minutes, then plays held-out episodes.

  Everything is compiled before, while other sections are at work; a line of standard
  input starts the clock.
  """
  config = gpu_config(settings, settings["train_worlds"])
  episodes = settings["eval_episodes"]
  env, agent = make_env(config.env), make_agent(config.agent)
  iteration: Any = make_iteration(config, env, agent)
  play: Any = make_player(env, lambda params: agent_policy(agent, params, greedy=False))
  example = jax.eval_shape(lambda: initial_state(config, env, agent, empty_expert))
  rows, key = jnp.zeros(episodes, jnp.int32), jax.random.key(0)

  def compiled() -> tuple[Any, float]:
    began = time.perf_counter()
    program = iteration.lower(example).compile()
    return program, time.perf_counter() - began

  with (
    _lock(settings, "compile", shared=True),
    concurrent.futures.ThreadPoolExecutor(3) as pool,
  ):
    first = pool.submit(compiled)
    player = pool.submit(
      lambda: play.lower(example.learner.params, rows, key).compile()
    )
    state = initial_state(config, env, agent, collect_expert)
    (program, compile_s), play = first.result(), player.result()
    jax.clear_caches()
    _, from_cache_s = compiled()
  emit(
    what="before training",
    worlds=config.env.worlds,
    updates_per_iteration=config.updates_per_iteration,
    compile_s=compile_s,
    compile_from_cache_s=from_cache_s,
    **memory(program),
  )
  terms = json.loads(sys.stdin.readline())
  with measuring(settings):
    until = min(time.time() + terms["seconds"], terms["until"])
    state = _train_until(until, program, state, config)
    began = time.perf_counter()
    figures = play_held_out(env, play, state.learner.params, episodes=episodes, seed=0)
    emit(what="held-out episodes", seconds=time.perf_counter() - began, **figures)


def _train_until(until: float, program: Any, state: Any, config: TrainConfig) -> Any:
  """Iterates, and reports every few seconds how episodes of training ended."""
  began = reported = time.time()
  successes = timeouts = 0
  while (now := time.time()) < until:
    state, metrics = program(state)
    successes += int(metrics["rollout/successes"])
    timeouts += int(metrics["rollout/timeouts"])
    if now - reported > 5.0:
      emit(
        what=f"training, {now - began:.0f} s",
        env_steps=int(state.env_steps),
        updates=int(state.learner.step),
        steps_per_s=int(state.env_steps) / (time.time() - began),
        success_rate=successes / max(successes + timeouts, 1),
        skipped_updates=int(metrics["faults/updates"]),
      )
      reported, successes, timeouts = now, 0, 0
  emit(
    what="training",
    seconds=time.time() - began,
    env_steps=int(state.env_steps),
    updates=int(state.learner.step),
    **memory(program),
  )
  return state


SECTIONS = {
  "device": device,
  "engines": engines,
  "raycaster": raycaster,
  "learner": learner,
  "worlds": worlds,
  "rates": rates,
  "train": train,
}


if __name__ == "__main__":
  # Without arguments it has been found that all imports are there.
  if len(sys.argv) > 1:
    SECTIONS[sys.argv[1]](json.loads(sys.argv[2]))
