"""Ways to lay out the ray caster's work, side by side, on the device at hand.

  python benchmarks/ray_layouts.py --quick
  python benchmarks/ray_layouts.py --store

Each draws the same pairs of images of push_plate; told is also which share of their
pixels is bit for bit what ``render`` draws. ``--json`` prints one JSON object and
nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Generator, Iterator
import contextlib
import copy
import dataclasses
import functools
from typing import Any
from unittest import mock

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from render import RESOLUTIONS, SCENE, make_pair, make_poses

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.render import Geoms, intersect, raycast
from apnpql_jax.sim.kinematics import Kinematics
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.types import Array

SIZES = RESOLUTIONS["paper"]
Cast = tuple[Array, Array]
"""Depth and paint of the rays of a block, f32[P] each; see ``raycast``."""


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__, repeats=15)
  parser.add_argument("--batch", type=int, nargs="+", default=[32, 256])
  parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
  args = timing.parse(parser)
  if args.quick:
    args.batch = [2]
  # Seconds of compilation are compared, too.
  jax.config.update("jax_enable_compilation_cache", False)
  timing.publish("ray_layouts", args, measure_all(args), scene=SCENE)


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Figures of every batch, its layouts timed in turns."""
  scene = load_scene(mjcf_path(SCENE))
  for batch in args.batch:
    poses = make_poses(scene, batch)
    plain = make_pair(scene, SIZES)
    expected, ready = jax.jit(plain)(poses), []
    floor_s = floor.count(plain, poses).seconds() / batch
    for name in args.layouts:
      layout = LAYOUTS[name]
      with layout.traced():
        pair = jax.jit(layout.pair(scene))
        run, compile_s = timing.compiled(pair, poses, options=layout.options)
      run = functools.partial(run, poses)
      ready.append(timing.Ready(run, floor_s, batch, compile_s))
    measured = timing.measure(ready, repeats=args.repeats)
    for name, pairs, times in zip(args.layouts, ready, measured, strict=True):
      drawn = zip(pairs.run(), expected, strict=True)
      same = [(images == others).all(-1).ravel() for images, others in drawn]
      yield {
        "layout": name,
        "batch": batch,
        **pairs.figures("pair", times),
        "agreeing": float(jnp.concatenate(same).mean()),
      }


@dataclasses.dataclass(frozen=True)
class Layout:
  """How the work is laid out, where that is not what ``render`` does."""

  parts: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Of ``raycast``, in the place of its own."""

  options: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Of XLA."""

  one_by_one: bool = False
  """Images follow one another, so that a condition can save work: in a batch XLA
  computes both of its branches."""

  still: bool = True
  """Whether the global camera draws what never moves before it. Without, images are
  not right: it is the most that could be gained by casting that once per episode."""

  @contextlib.contextmanager
  def traced(self) -> Generator[None]:
    """What ``pair`` returned must be traced in here."""
    parts: dict[str, Any] = {"BLOCKS": raycast.BLOCKS} | self.parts
    with mock.patch.multiple(raycast, **parts):
      yield

  def pair(self, scene: Scene) -> Callable[[Kinematics], list[Array]]:
    """See ``make_pair``; geoms are new at each call, hence no trace is reused."""
    whole = make_pair(scene, SIZES)
    overview = whole if self.still else make_pair(without_still(scene), SIZES)

    def draw(poses: Kinematics) -> list[Array]:
      return [overview(poses)[0], whole(poses)[1]]

    return functools.partial(jax.lax.map, draw) if self.one_by_one else draw


def without_still(scene: Scene) -> Scene:
  """The scene in which all that stands still during an episode is invisible."""
  model = copy.copy(scene.model)
  still = (model.body_weldid == 0) | (model.body_mocapid >= 0)
  model.geom_rgba[still[model.geom_bodyid], 3] = 0.0
  return dataclasses.replace(scene, model=model)


def cast_by_type(
  geoms: Geoms,
  lighting: Any,
  look: Any,
  frames: intersect.Frames,
  basis: Array,
  near: float,
  rays: intersect.Rays,
) -> Cast:
  """As ``raycast._cast`` without checkers and shadows: all geoms of a type at once, and
  the nearest of all hits afterwards."""
  ray_light = intersect.along(basis[2], rays)

  def hits(kind: int) -> Cast:
    def one(geom: intersect.Frames) -> Cast:
      t, cosine = intersect.HITS[kind](geom, rays, ray_light)
      shape = rays.u.shape
      return jnp.broadcast_to(t, shape), jnp.broadcast_to(cosine, shape)

    return jax.vmap(one)(jax.tree.map(lambda x: x[geoms.types == kind], frames))

  kinds = np.unique(geoms.types).tolist()  # The order that the geoms have.
  t, cosine = map(jnp.concatenate, zip(*map(hits, kinds), strict=True))
  t = jnp.where(t > near, t, intersect.MISS)
  nearest = jnp.argmin(t, axis=0)
  t, cosine = (jnp.take_along_axis(x, nearest[None], axis=0)[0] for x in (t, cosine))
  paint = nearest + raycast._intensity(lighting, look, cosine)
  return t, jnp.where(t < intersect.MISS, paint, raycast.nothing(geoms))


def cast_in_sight(
  cast: Callable[..., Cast],
  geoms: Geoms,
  lighting: Any,
  look: Any,
  frames: intersect.Frames,
  basis: Array,
  near: float,
  rays: intersect.Rays,
) -> Cast:
  """As ``cast`` without checkers, but geoms that no ray of the block can meet are
  skipped."""

  def nearer(k: int, seen: Cast) -> Cast:
    names = [field.name for field in dataclasses.fields(geoms)]
    alone = Geoms(**{name: getattr(geoms, name)[k : k + 1] for name in names})
    frame = jax.tree.map(lambda x: x[k : k + 1], frames)
    t, paint = cast(alone, lighting, look, frame, basis, near, rays)
    closer = t < seen[0]
    return jnp.where(closer, t, seen[0]), jnp.where(closer, paint + k, seen[1])

  shape = rays.u.shape
  seen = jnp.full(shape, intersect.MISS), jnp.full(shape, raycast.nothing(geoms))
  for k, kind in enumerate(geoms.types.tolist()):
    in_sight = may_meet(kind, intersect.row(frames, k), rays)
    seen = jax.lax.cond(in_sight, functools.partial(nearer, k), lambda seen: seen, seen)
  return seen


def may_meet(kind: int, geom: intersect.Frames, rays: intersect.Rays) -> Array | bool:
  """bool[]: the ball around a geom is within the pyramid around the rays."""
  if kind == mujoco.mjtGeom.mjGEOM_PLANE:
    return True
  is_capsule = kind == mujoco.mjtGeom.mjGEOM_CAPSULE
  radius = geom.size.sum() if is_capsule else jnp.linalg.norm(geom.size)
  x, y, z = geom.center
  outside = z - radius
  for across, slope in ((x, rays.u), (y, rays.v)):
    for sign, most in ((1.0, slope.max()), (-1.0, -slope.min())):
      beyond = (sign * across + most * z) * jax.lax.rsqrt(1.0 + most * most)
      outside = jnp.maximum(outside, beyond - radius)
  return outside < 0.0


def cast_in(
  dtype: Any,
  cast: Callable[..., Cast],
  geoms: Geoms,
  lighting: Any,
  look: Any,
  *args: Any,
) -> Cast:
  """``cast`` in another precision."""

  def converted(x: Any) -> Any:
    return x.astype(dtype) if isinstance(x, jax.Array | np.ndarray) else x

  return cast(geoms, lighting, look, *jax.tree.map(converted, args))


def in_full(intensity: Callable[..., Array], *args: Any) -> Array:
  """Colour and intensity share one number, which half precision cannot hold."""
  return intensity(*args).astype(jnp.float32)


LAYOUTS = {
  "fold, 4 blocks": Layout({"BLOCKS": 4}),
  "fold, 1 block": Layout({"BLOCKS": 1}),
  "fold, 16 blocks": Layout({"BLOCKS": 16}),
  "types at once": Layout({"_cast": cast_by_type}),
  "bfloat16": Layout(
    {
      "_cast": functools.partial(cast_in, jnp.bfloat16, raycast._cast),
      "_intensity": functools.partial(in_full, raycast._intensity),
    }
  ),
  "fast math": Layout(
    options={
      "xla_cpu_enable_fast_math": True,
      "xla_cpu_fast_math_honor_division": False,
      "xla_cpu_fast_math_honor_functions": False,
    }
  ),
  "one by one": Layout(one_by_one=True),
  "one by one, in sight": Layout(
    {"_cast": functools.partial(cast_in_sight, raycast._cast), "BLOCKS": 16},
    one_by_one=True,
  ),
  "without what is still": Layout(still=False),
}
"""The first is that of ``render``."""


if __name__ == "__main__":
  main()
