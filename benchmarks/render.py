"""Camera pairs per second of the ray caster on push_plate, by batch and resolution.

  python benchmarks/render.py --quick
  python benchmarks/render.py --store

A pair is one image of "global" and one of "wrist" of the same world; some batches are
also drawn with the shadow of the hand. MuJoCo's software rendering and PyBullet's
TinyRenderer are timed in the same run, where they are installed. ``--json`` prints one
JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import functools
import itertools
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from other_renderers import measure_others

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.envs.cameras import make_cameras
from apnpql_jax.render import Geoms
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.types import Array

SCENE = "push_plate"
RESOLUTIONS = {
  "paper": {"global": (72, 96), "wrist": (36, 64)},
  "sim_to_real": {"global": (120, 160), "wrist": (60, 107)},
}


def main() -> None:
  """Command line; see the module's docstring."""
  args = timing.parse(_parser())
  if args.quick:
    args.batch, args.shadow, args.resolutions = [1, 2], [2], ["paper"]
  resolutions = {name: RESOLUTIONS[name] for name in args.resolutions}
  scene = load_scene(mjcf_path(SCENE))
  timing.publish(
    "render",
    args,
    measure_all(scene, resolutions, args),
    scene=SCENE,
    geoms=len(Geoms.from_model(scene.model).ids),
    resolutions=resolutions,
  )


def measure_all(
  scene: Scene, resolutions: dict[str, Any], args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Figures of every size: of other renderers, then of ours, its batches in turns."""
  for name, sizes in resolutions.items():
    others = {}
    if not args.alone:
      others = measure_others(mjcf_path(SCENE), sizes, repeats=args.repeats)
    for renderer, found in others.items():
      yield {"resolution": name, "renderer": renderer, **found}
    plain = itertools.product([False], args.batch)
    rows, ready = [*plain, *itertools.product([True], args.shadow)], []
    for shadow, batch in rows:
      pair, poses = make_pair(scene, sizes, shadow=shadow), make_poses(scene, batch)
      run, compile_s = timing.compiled(jax.jit(pair), poses)
      floor_s = floor.count(pair, poses).seconds() / batch
      ready.append(
        timing.Ready(functools.partial(run, poses), floor_s, batch, compile_s)
      )
    measured = timing.measure(ready, repeats=args.repeats)
    for (shadow, batch), pairs, times in zip(rows, ready, measured, strict=True):
      yield {
        "resolution": name,
        "renderer": "ray_caster",
        "batch": batch,
        "shadow": shadow,
        **pairs.figures("pair", times),
      }


def _parser() -> argparse.ArgumentParser:
  parser = timing.parser(__doc__, repeats=15)
  parser.add_argument(
    "--alone", action="store_true", help="without the other renderers"
  )
  parser.add_argument(
    "--resolutions", nargs="+", choices=RESOLUTIONS, default=list(RESOLUTIONS)
  )
  parser.add_argument(
    "--batch", type=int, nargs="+", default=[1, 8, 16, 32, 64, 128, 256]
  )
  parser.add_argument(
    "--shadow", type=int, nargs="*", default=[64], help="batches with a shadow, too"
  )
  return parser


def make_pair(
  scene: Scene, sizes: dict[str, tuple[int, int]], *, shadow: bool = False
) -> Callable[[Kinematics], list[Array]]:
  """A function from poses [*b, ...] to the images of both cameras, u8[*b, H, W, 3]."""
  sides: dict[str, Any] = {f"{name}_size": size for name, size in sizes.items()}
  cameras = make_cameras(EnvConfig(shadows=shadow, **sides), scene)
  return lambda poses: [camera(poses) for camera in cameras]


def make_poses(scene: Scene, batch: int) -> Kinematics:
  """Worlds [batch, ...] with the arm about its working posture."""
  data, rng = mujoco.MjData(scene.model), np.random.default_rng(0)
  names = {field.name for field in dataclasses.fields(Kinematics)} - {"fields"}
  worlds = []
  for _ in range(batch):
    mujoco.mj_resetData(scene.model, data)
    data.qpos[:6] = [0.0, -1.2, 1.9, -2.2, -1.57, 0.0] + rng.normal(size=6) * 0.2
    mujoco.mj_forward(scene.model, data)
    worlds.append({name: np.array(getattr(data, name), np.float32) for name in names})
  poses = {}
  for name in names:
    tail = (3, 3) if name.endswith("mat") else (3,)
    stacked = np.stack([world[name] for world in worlds])
    poses[name] = jnp.asarray(stacked.reshape(batch, -1, *tail))
  return Kinematics(**poses, fields={})


if __name__ == "__main__":
  main()
