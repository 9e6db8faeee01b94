"""Pairs of images per second by the layout of the ray caster's work.

  python -m benchmarks.speed.ray_layouts --store

All layouts draw the same pairs of images of push_plate. "agreeing" is the share of the
pixels whose bits equal those of ``render``.
"""

import argparse
from collections.abc import Iterator
import copy
import dataclasses
import functools
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.render import Geoms, intersect, raycast
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.types import Array
from benchmarks.common import command, floor, timing
from benchmarks.speed.render import RESOLUTIONS, SCENE, Sizes, make_pair, make_poses

Cast = tuple[Array, Array]
"""Depth and paint of the rays of a block, f32[P] each; see ``raycast``."""


def main() -> None:
  parser = command.parser(__doc__, repeats=15)
  parser.add_argument("--batch", type=int, nargs="+", default=[32, 256])
  parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
  args = command.parse(parser)
  sizes = RESOLUTIONS["tiny" if args.quick else "paper"]
  args.batch = [2] if args.quick else args.batch
  # Seconds of compilation are compared, too.
  jax.config.update("jax_enable_compilation_cache", False)
  command.publish("ray_layouts", args, measure_all(args, sizes), scene=SCENE)


def measure_all(args: argparse.Namespace, sizes: Sizes) -> Iterator[dict[str, Any]]:
  """Yields the figures of every batch, its layouts timed in turns."""
  scene = load_scene(mjcf_path(SCENE))
  plain = make_pair(scene, sizes)
  for batch in args.batch:
    poses = make_poses(scene, batch)
    floor_s, ready = floor.count(plain, poses).seconds() / batch, {}
    for name in args.layouts:
      run, compile_s = prepare(scene, sizes, poses, **LAYOUTS[name])
      run = functools.partial(run, poses)
      ready[name] = timing.Ready(run, floor_s, batch, compile_s)
    expected = jax.jit(plain)(poses)
    found = timing.figures("pair", ready, repeats=args.repeats)
    for name, figures in found.items():
      share = agreeing(ready[name].run(), expected)
      yield {"layout": name, "batch": batch, **figures, "agreeing": share}


def agreeing(drawn: list[Array], expected: list[Array]) -> float:
  """Returns the share of the pixels that are the same bits."""
  pairs = zip(drawn, expected, strict=True)
  same = [(images == others).all(-1).ravel() for images, others in pairs]
  return float(jnp.concatenate(same).mean())


def prepare(
  scene: Scene, sizes: Sizes, poses: Any, still=True, options: Any = None, **parts: Any
) -> tuple[Any, float]:
  """Compiles both images with other ``parts`` of ``raycast`` or ``options`` of XLA.

  Without what is ``still`` in front of the global camera its images are wrong. That
  bounds the gain of casting still geoms once per episode.
  """
  whole = make_pair(scene, sizes)
  overview = whole if still else make_pair(without_still(scene), sizes)
  patches: dict[str, Any] = {"BLOCKS": raycast.BLOCKS} | parts
  with mock.patch.multiple(raycast, **patches):
    pair = jax.jit(lambda poses: [overview(poses)[0], whole(poses)[1]])
    return timing.compiled(pair, poses, options=options)


def without_still(scene: Scene) -> Scene:
  """Returns the scene with everything invisible that is still during an episode."""
  model = copy.copy(scene.model)
  still = (model.body_weldid == 0) | (model.body_mocapid >= 0)
  model.geom_rgba[still[model.geom_bodyid], 3] = 0.0
  return dataclasses.replace(scene, model=model)


def cast_by_type(geoms: Geoms, lighting, look, frames, basis, near, rays) -> Cast:
  """Casts all geoms of a type at once, then picks the nearest hit; no shadows."""
  ray_light = intersect.along(basis[2], rays)

  def hits(kind: int) -> Cast:
    def one(geom: Any) -> Cast:
      t, cosine = intersect.HITS[kind](geom, rays, ray_light)
      return jnp.broadcast_to(t, rays.u.shape), jnp.broadcast_to(cosine, rays.u.shape)

    return jax.vmap(one)(jax.tree.map(lambda x: x[geoms.types == kind], frames))

  kinds = np.unique(geoms.types).tolist()  # In the order of the geoms.
  t, cosine = map(jnp.concatenate, zip(*map(hits, kinds), strict=True))
  t = jnp.where(t > near, t, intersect.MISS)
  nearest = jnp.argmin(t, axis=0)
  t, cosine = (jnp.take_along_axis(x, nearest[None], axis=0)[0] for x in (t, cosine))
  paint = nearest + raycast._intensity(lighting, look, cosine)
  return t, jnp.where(t < intersect.MISS, paint, raycast.nothing(geoms))


_FAST_MATH = {
  "xla_cpu_enable_fast_math": True,
  "xla_cpu_fast_math_honor_division": False,
  "xla_cpu_fast_math_honor_functions": False,
}
LAYOUTS: dict[str, dict[str, Any]] = {
  "fold, 4 blocks": {"BLOCKS": 4},
  "fold, 1 block": {"BLOCKS": 1},
  "fold, 16 blocks": {"BLOCKS": 16},
  "types at once": {"_cast": cast_by_type},
  "fast math": {"options": _FAST_MATH},
  "without what is still": {"still": False},
}
"""The first is that of ``render``."""


if __name__ == "__main__":
  main()
