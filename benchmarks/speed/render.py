"""Camera pairs per second of the ray caster on push_plate, by batch and resolution.

  python -m benchmarks.speed.render --store

A pair is one image of "global" and one of "wrist" of the same world. Some batches are
also drawn with the shadow of the hand. MuJoCo's renderer and PyBullet's TinyRenderer
draw pairs in the same run, one world in one process, where they are installed.
"""

import argparse
from collections.abc import Callable, Iterator
import functools
import itertools
from pathlib import Path
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.render import Geoms
from apnpql_jax.sim.kinematics import Kinematics, make_kinematics
from apnpql_jax.sim.physics import initial_state
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.tasks import make_task
from apnpql_jax.types import Array
from benchmarks.common import command, floor, timing
from benchmarks.peers import sides, worlds

SCENE = "push_plate"
Sizes = dict[str, tuple[int, int]]  # height and width of the images, by camera

RESOLUTIONS: dict[str, Sizes] = {
  "paper": {"global": (72, 96), "wrist": (36, 64)},
  "real_robot": {"global": (120, 160), "wrist": (60, 107)},
  "tiny": {"global": (12, 16), "wrist": (8, 12)},
}
OTHERS: dict[str, tuple[str, dict[str, Any]]] = {
  "mujoco_egl": ("mujoco_worlds", {"MUJOCO_GL": "egl"}),
  "mujoco_osmesa": ("mujoco_worlds", {"MUJOCO_GL": "osmesa"}),
  "pybullet_tiny": ("pybullet_worlds", {}),
}
"""Renderer -> its side, see ``benchmarks.peers``, and environment variables."""


def main() -> None:
  parser = command.parser(__doc__, repeats=15)
  flag = parser.add_argument
  flag("--alone", action="store_true", help="without the other renderers")
  names = ["paper", "real_robot"]
  flag("--resolutions", nargs="+", choices=RESOLUTIONS, default=names)
  flag("--batch", type=int, nargs="+", default=[1, 8, 16, 32, 64, 128, 256])
  flag("--shadow", type=int, nargs="*", default=[64], help="batches with a shadow, too")
  args = command.parse(parser)
  if args.quick:
    args.batch, args.shadow, args.resolutions = [2], [2], ["tiny"]
  scene = load_scene(mjcf_path(SCENE))
  header = {
    "scene": SCENE,
    "geoms": len(Geoms.from_model(scene.model).ids),
    "resolutions": {name: RESOLUTIONS[name] for name in args.resolutions},
  }
  command.publish("render", args, measure_all(scene, args), **header)


def measure_all(scene: Scene, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the figures of other renderers, then of ours with its batches in turns."""
  for name in args.resolutions:
    sizes = RESOLUTIONS[name]
    for renderer in () if args.alone else OTHERS:
      figures = measure_other(renderer, sizes, args.repeats)
      yield {"resolution": name, "renderer": renderer, **figures}
    plain = itertools.product([False], args.batch)
    rows = [*plain, *itertools.product([True], args.shadow)]
    ready = {(on, batch): prepare(scene, sizes, batch, shadow=on) for on, batch in rows}
    found = timing.figures("pair", ready, repeats=args.repeats)
    for (shadow, batch), figures in found.items():
      setting = {"batch": batch, "shadow": shadow}
      yield {"resolution": name, "renderer": "ray_caster", **setting, **figures}


def measure_other(renderer: str, sizes: Sizes, repeats: int) -> dict[str, Any]:
  """Returns pairs per second of another renderer, or why there are none."""
  module, env = OTHERS[renderer]
  with tempfile.TemporaryDirectory() as folder:
    worlds.export(SCENE, sizes, Path(folder))
    settings = {"folder": folder, "gymnasium": False}
    try:
      with sides.Side(module, settings, limit_s=120, **env) as side:
        side.rate("images", timing.SECONDS)  # Makes the renderer; does not count.
        rates = [side.rate("images", 2 * timing.SECONDS) for _ in range(repeats)]
    except sides.SideFailed as error:
      return {"missing": str(error)}
  return timing.spread("pairs_per_s", rates)


def prepare(scene: Scene, sizes: Sizes, batch: int, *, shadow: bool) -> timing.Ready:
  """Compiles the images of a batch of worlds."""
  pair, poses = make_pair(scene, sizes, shadow=shadow), make_poses(scene, batch)
  run, compile_s = timing.compiled(jax.jit(pair), poses)
  floor_s = floor.count(pair, poses).seconds() / batch
  return timing.Ready(functools.partial(run, poses), floor_s, batch, compile_s)


def make_pair(
  scene: Scene, sizes: Sizes, *, shadow: bool = False
) -> Callable[[Kinematics], list[Array]]:
  """Returns a function from poses [*b, ...] to both images, u8[*b, H, W, 3]."""
  config: dict[str, Any] = {f"{name}_size": size for name, size in sizes.items()}
  cameras = make_cameras(EnvConfig(shadows=shadow, **config), scene)
  return lambda poses: [camera(poses) for camera in cameras]


def make_poses(scene: Scene, batch: int) -> Kinematics:
  """Draws reset states of the scene and returns their poses [batch, ...]."""
  draw = make_task(scene.name).sample_resets(np.random.default_rng(0), batch)
  return make_kinematics(scene)(initial_state(scene, *map(jnp.asarray, draw)))


if __name__ == "__main__":
  main()
