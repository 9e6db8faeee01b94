"""Growth of time with worlds, candidates, image size, replay size and contacts.

  python -m benchmarks.speed.growth --store --axes worlds --worlds 1 16 256

The task is push_plate, except for contacts. There it is place_plate, which has the
most: some of its contact pairs are removed, and every point of the others gets a slot.
Sizes for which the memory does not suffice are left out.
"""

import argparse
from collections.abc import Iterator
import dataclasses
import functools
import itertools
import sys
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from apnpql_jax import devices
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.envs.env import make_env
from apnpql_jax.errors import ConfigError
from apnpql_jax.sim.engines import make_physics
from apnpql_jax.sim.physics import initial_state
from apnpql_jax.sim.quiet_mjx import mjx
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.tasks import make_task
from apnpql_jax.tasks.contact_report import SUBSTEPS
from apnpql_jax.training.rollout import example_slot
from benchmarks.common import command, floor, noise, parts, settings, timing
from benchmarks.speed import env_steps, learner

WORLDS, CANDIDATES, PLAYED = 32, 120, 16
"""Worlds and candidates, except along their axes; periods after the reset at which
worlds are timed."""

Sizes = Iterator[tuple[Any, ...]]
"""Series, size, a function that prepares it, and its arguments."""


def main() -> None:
  parser = command.parser(__doc__, repeats=3)
  lists = functools.partial(parser.add_argument, nargs="+")
  lists("--axes", choices=AXES, default=list(AXES))
  lists("--backends", choices=settings.ENGINES, default=settings.ENGINES)
  lists("--worlds", type=int, default=[4**n for n in range(7)])
  lists("--candidates", type=int, default=[10, 30, 100, 200, 500])
  lists("--scales", type=float, default=[0.5, 1.0, 2.0, 4.0], help="of image sides")
  lists("--slots", type=int, default=[1280 * 4**n for n in range(5)], help="of replay")
  lists("--pairs", type=int, default=[4, 8, 16, 32, 53], help="that may touch")
  args = command.parse(parser)
  if args.quick:
    args.backends, args.worlds, args.candidates = ["native"], [1, 2], [4]
    args.scales, args.slots, args.pairs = [1.0], [256], [4]
  command.publish("growth", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the figures of every size; the sizes of an axis are timed in turns."""
  config = settings.preset("push_plate", quick=args.quick)
  for axis in args.axes:
    ready = {}
    for series, size, prepare, *given in AXES[axis](config, args):
      try:
        ready[series, size] = prepare(*given)
      except ConfigError as error:  # The memory does not suffice.
        print(f"{axis} {series} {size}: {error}", file=sys.stderr)
    times = timing.measure(ready, repeats=args.repeats)
    for (series, size), run in ready.items():
      found = times[series, size]
      figures = timing.spread("seconds", found.wall)
      figures |= floor.compare(run.floor_s or 0.0, found.seconds)
      yield {"axis": axis, "series": series, "size": size, **figures}


def worlds(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Yields one control period with images and random actions."""
  for backend, count in itertools.product(args.backends, args.worlds):
    chosen = settings.changed(config, "env", backend=backend, worlds=count)
    yield backend, count, _period, chosen.env


def candidates(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Yields one update."""
  for count in args.candidates:
    yield "update", count, _update, settings.with_candidates(config, count)


def pixels(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Yields the images of all worlds, and one update with such images."""
  for scale in args.scales:
    names = ("global_size", "wrist_size")
    sides = {k: tuple(round(scale * x) for x in getattr(config.env, k)) for k in names}
    chosen = settings.changed(config, "env", **sides, worlds=WORLDS)
    chosen = settings.with_candidates(chosen, CANDIDATES)
    size = sum(height * width for height, width in sides.values())
    yield "rendering", size, _images, chosen.env
    yield "update", size, _update, chosen


def slots(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Yields the storage of a rollout with a broken world, and the draw of a batch."""
  for count in args.slots:
    yield "add and draw", count, _replay, config, count


def contacts(config: TrainConfig, args: argparse.Namespace) -> Sizes:
  """Yields the physics of one control period of place_plate."""
  del config
  for count in args.pairs:
    keep = functools.partial(_keep_pairs, count)
    scene = load_scene(mjcf_path("place_plate"), variants=[keep])
    size = mjx.make_data(scene.model, impl="jax")._impl.ncon
    for backend in args.backends:
      yield backend, size, _physics, scene, backend


AXES = {f.__name__: f for f in (worlds, candidates, pixels, slots, contacts)}


def _period(config: EnvConfig) -> timing.Ready:
  env = make_env(config)
  state = env.reset(jnp.arange(config.worlds) % env.bank_split)
  run, _ = env_steps.player(env, lambda _: parts.random_policy, None, state, length=1)
  for _ in range(PLAYED):
    run()
  images = floor.count(functools.partial(parts.draw, env, config), state.physics)
  physics = parts.physics_work(env.physics, state.physics)
  return timing.Ready(run.again, images.seconds() + physics.seconds())


def _update(config: TrainConfig) -> timing.Ready:
  return learner.prepare(make_agent(config.agent), noise.transitions(config))


def _images(config: EnvConfig) -> timing.Ready:
  env = make_env(dataclasses.replace(config, obs="state"))
  state = env.reset(jnp.arange(config.worlds)).physics
  draw = functools.partial(parts.draw, env, config)
  run, _ = timing.compiled(jax.jit(draw), state)
  floor_s = floor.count(draw, state).seconds()
  return timing.Ready(functools.partial(run, state), floor_s)


def _replay(config: TrainConfig, count: int) -> timing.Ready:
  env, worlds, agent = make_env(config.env), config.env.worlds, config.agent
  seen = jax.eval_shape(env.reset, jnp.zeros(worlds, jnp.int32))
  create = functools.partial(replay.create, example_slot(seen), worlds=worlds)
  length = count // worlds
  need = floor.nbytes(jax.eval_shape(functools.partial(create, length=length)))
  devices.check_memory(need, "the replay")
  ring = create(length=length).replace(size=jnp.full((), length))
  chunk = create(length=config.rollout_length).slots
  draw: dict[str, Any] = {
    "batch_size": config.replay.batch_size,
    "n_step": agent.n_step,
    "gamma": agent.gamma,
  }

  def step(carry: Any, chunk: Any) -> Any:
    ring, key = carry
    key, draw_key = jax.random.split(key)
    ring = replay.exclude(replay.add(ring, chunk), jnp.zeros(worlds, jnp.int32))
    return (ring, key), replay.sample(ring, draw_key, **draw)

  carry = (ring, jax.random.key(0))
  run, _ = timing.compiled(jax.jit(step, donate_argnums=0), carry, chunk)
  carried = timing.Carried(lambda carry: run(carry, chunk), carry)
  # Both are read in one place and written in another.
  moved = floor.nbytes((chunk, jax.eval_shape(step, carry, chunk)[1]))
  return timing.Ready(carried, floor.Work(0.0, 2 * moved).seconds())


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
