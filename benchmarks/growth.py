"""How time grows with worlds, candidates, image size, replay size and contacts.

  python benchmarks/growth.py --quick
  python benchmarks/growth.py --store --axes worlds --worlds 1 16 256

On push_plate, but for contacts: there place_plate, which has the most, loses more and
more of its contact pairs, and has a slot for every point of the others. Sizes for which
the memory does not suffice are left out.
``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import functools
import sys
from typing import Any

from apnpql_jax import devices

import timing  # isort: skip  (before JAX: sets threads and cache)
import env_steps
import floor
import jax
import jax.numpy as jnp
import learner
import mujoco
from mujoco import mjx
import numpy as np
import parts
import settings
import tables

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset, mjcf_path
from apnpql_jax.config.schema import AgentConfig, EnvConfig, TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.envs.contact_report import SUBSTEPS
from apnpql_jax.envs.env import make_env
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim.engines import make_physics
from apnpql_jax.sim.physics import initial_state
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.tasks import make_task
from apnpql_jax.training.expert import example_slot
from apnpql_jax.types import Observation

sys.path.append(str(tables.ROOT / "tests"))
from apnpql_jax.testing import random_batch

BATCH = 64
WORLDS = 32
"""Where they are not what grows."""

PLAYED = 16
"""Periods after the reset at which worlds are timed, however many there are."""

Sizes = Iterator[tuple[str, int, Callable[[], timing.Ready]]]
"""Series, size, and what prepares it."""


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__, repeats=3)
  lists = functools.partial(parser.add_argument, nargs="+")
  lists("--axes", choices=AXES, default=list(AXES))
  lists("--backends", choices=settings.ENGINES, default=settings.ENGINES)
  lists("--worlds", type=int, default=[4**n for n in range(7)])
  lists("--candidates", type=int, default=[10, 30, 100, 200, 500])
  lists("--scales", type=float, default=[0.5, 1.0, 2.0, 4.0], help="of image sides")
  lists("--slots", type=int, default=[1280 * 4**n for n in range(5)], help="of replay")
  lists("--pairs", type=int, default=[4, 8, 16, 32, 53], help="that may touch")
  args = timing.parse(parser)
  if args.quick:
    args.backends, args.worlds, args.candidates = ["native"], [1, 2], [4]
    args.scales, args.slots, args.pairs = [1.0], [256], [4]
  timing.publish("growth", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Figures of every size along every axis, those of an axis timed in turns."""
  config = settings.tiny_pixels() if args.quick else load_preset("push_plate")
  for axis in args.axes:
    points, ready = [], []
    for series, size, prepare in AXES[axis](config, args):
      try:
        ready.append(prepare())
      except ConfigError as error:  # The memory does not suffice.
        print(f"{axis} {series} {size}: {error}", file=sys.stderr)
        continue
      points.append((series, size))
    measured = timing.measure(ready, repeats=args.repeats)
    for (series, size), run, times in zip(points, ready, measured, strict=True):
      figures = timing.spread(times.wall) | floor.compare(run.floor_s, times.seconds)
      yield {"axis": axis, "series": series, "size": size, **figures}


def worlds(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """One control period with images, acting at random."""
  for backend in args.backends:
    for count in args.worlds:
      env = dataclasses.replace(config.env, backend=backend, worlds=count)
      yield backend, count, functools.partial(_period, env)


def candidates(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """One update."""
  for count in args.candidates:
    agent = learner.with_candidates(config.agent, count)
    yield "update", count, functools.partial(_update, agent, config.env)


def pixels(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Images of all worlds, and one update that looks at such images."""
  for scale in args.scales:
    sides = {
      name: tuple(round(scale * side) for side in getattr(config.env, name))
      for name in ("global_size", "wrist_size")
    }
    env = dataclasses.replace(config.env, **sides, worlds=WORLDS)
    size = sum(height * width for height, width in sides.values())
    yield "rendering", size, functools.partial(_images, env)
    yield "update", size, functools.partial(_update, config.agent, env)


def slots(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Adding what a rollout brings, looking what of it to leave out, drawing a batch."""
  for count in args.slots:
    yield "add and draw", count, functools.partial(_replay, config, count)


def contacts(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """The physics of one control period of place_plate."""
  del config
  for count in args.pairs:
    keep = functools.partial(_keep_pairs, count)
    scene = load_scene(mjcf_path("place_plate"), variants=[keep])
    size = mjx.make_data(scene.model, impl="jax")._impl.ncon
    for backend in args.backends:
      yield backend, size, functools.partial(_physics, scene, backend)


AXES = {
  "worlds": worlds,
  "candidates": candidates,
  "pixels": pixels,
  "slots": slots,
  "contacts": contacts,
}


def _period(config: EnvConfig) -> timing.Ready:
  env = make_env(config)
  state = env.reset(jnp.arange(config.worlds) % env.bank_split)
  run, _ = env_steps.player(env, lambda _: parts.random_policy, None, state, length=1)
  for _ in range(PLAYED):
    run()
  images = floor.count(functools.partial(parts.draw, env, config), state.physics)
  physics = parts.physics_work(env.physics, state.physics)
  return timing.Ready(run.again, images.seconds() + physics.seconds())


def _update(config: AgentConfig, env: EnvConfig) -> timing.Ready:
  rng = np.random.default_rng(0)

  def look(seen: Observation) -> Observation:
    images = {
      name: jnp.asarray(rng.integers(0, 256, (BATCH, *size, 3)), jnp.uint8)
      for name, size in (
        ("global_image", env.global_size),
        ("wrist_image", env.wrist_size),
      )
    }
    return seen.replace(objects=None, **images)

  batch = random_batch(0, BATCH)
  batch = batch.replace(
    observation_tm1=look(batch.observation_tm1), observation_t=look(batch.observation_t)
  )
  return learner.prepare(make_agent(config), batch)


def _images(config: EnvConfig) -> timing.Ready:
  env = make_env(dataclasses.replace(config, obs="state"))
  state = env.reset(jnp.arange(config.worlds)).physics
  draw = functools.partial(parts.draw, env, config)
  run, _ = timing.compiled(jax.jit(draw), state)
  floor_s = floor.count(draw, state).seconds()
  return timing.Ready(functools.partial(run, state), floor_s)


def _replay(config: TrainConfig, count: int) -> timing.Ready:
  env = make_env(config.env)
  seen = jax.eval_shape(env.reset, jnp.zeros(config.env.worlds, jnp.int32))
  create = functools.partial(
    replay.create, example_slot(seen), worlds=config.env.worlds
  )
  length = count // config.env.worlds
  need = floor.nbytes(jax.eval_shape(functools.partial(create, length=length)))
  devices.check_memory(need, "the replay")
  ring = create(length=length).replace(size=jnp.full((), length))
  chunk = create(length=config.rollout_length).slots
  none = jnp.zeros(config.env.worlds, jnp.int32)

  def step(carry: Any, chunk: Any) -> Any:
    ring, key = carry
    key, draw_key = jax.random.split(key)
    ring = replay.exclude(replay.add(ring, chunk), none)
    batch = replay.sample(
      ring,
      draw_key,
      batch_size=BATCH,
      n_step=config.agent.n_step,
      gamma=config.agent.gamma,
    )
    return (ring, key), batch

  carry = (ring, jax.random.key(0))
  jitted = jax.jit(step, donate_argnums=0)
  run, _ = timing.compiled(jitted, carry, chunk)
  go_on = timing.Carried(lambda carry: run(carry, chunk), carry)
  # Each is read here and written there.
  moved = floor.nbytes((chunk, jax.eval_shape(step, carry, chunk)[1]))
  return timing.Ready(go_on, floor.Work(0.0, 2 * moved).seconds())


def _keep_pairs(count: int, spec: mujoco.MjSpec) -> None:
  spec.delete(spec.numeric("max_contact_points"))
  for pair in list(spec.pairs)[count:]:
    spec.delete(pair)


def _physics(scene: Scene, backend: str) -> timing.Ready:
  draw = make_task(scene.name).sample_resets(np.random.default_rng(0), WORLDS)
  state = initial_state(scene, *map(jnp.asarray, draw))
  engine = make_physics(backend, scene, substeps=SUBSTEPS)
  inputs = (state, jnp.zeros((WORLDS, 6)), jnp.zeros(WORLDS))
  run, _ = timing.compiled(jax.jit(engine.step), *inputs)
  floor_s = parts.physics_work(engine, state).seconds()
  return timing.Ready(functools.partial(run, *inputs), floor_s)


if __name__ == "__main__":
  main()
