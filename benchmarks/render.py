"""Camera pairs per second of the ray caster on push_plate, by batch and resolution.

  python benchmarks/render.py --quick
  python benchmarks/render.py --store

A pair is one image of "global" and one of "wrist" of the same world. MuJoCo's software
rendering and PyBullet's TinyRenderer are timed in the same run, where they are
installed. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import functools
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from other_renderers import measure_others
import tables

from apnpql_jax.render import CameraSpec, Geoms, Lighting, render

SCENE = tables.ROOT / "mjcf" / "push_plate.xml"
RESOLUTIONS = {
  "paper": {"global": (72, 96), "wrist": (36, 64)},
  "sim_to_real": {"global": (120, 160), "wrist": (60, 107)},
}


def main() -> None:
  """Command line; see the module's docstring."""
  args = timing.parse(_parser())
  if args.quick:
    args.batch, args.resolutions = [1, 2], ["paper"]
  resolutions = {name: RESOLUTIONS[name] for name in args.resolutions}
  model = mujoco.MjModel.from_xml_path(str(SCENE))
  timing.publish(
    "render",
    args,
    measure_all(model, resolutions, args),
    scene=SCENE.stem,
    geoms=len(Geoms.from_model(model).ids),
    resolutions=resolutions,
    outputs=args.outputs,
    shadow_casters=args.casters,
  )


def measure_all(
  model: mujoco.MjModel, resolutions: dict[str, Any], args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Figures of every renderer and size, one after the other."""
  for name, cameras in resolutions.items():
    others = {} if args.alone else measure_others(SCENE, cameras)
    for renderer, found in others.items():
      yield {"resolution": name, "renderer": renderer, **found}
    pair = _make_pair(model, cameras, args.casters, args.outputs)
    for size in args.batch:
      poses = _poses(model, size)
      run, compile_s = timing.compiled(jax.jit(pair), *poses)
      times = timing.measure(functools.partial(run, *poses), repeats=args.repeats)
      floor_s = floor.count(pair, *poses).seconds()
      yield {
        "resolution": name,
        "renderer": "ray_caster",
        "batch": size,
        **times.per(size).rate("pair"),
        "compile_s": compile_s,
        **floor.compare(floor_s / size, times.per(size).seconds),
      }


def _parser() -> argparse.ArgumentParser:
  parser = timing.parser(__doc__)
  parser.add_argument(
    "--alone", action="store_true", help="without the other renderers"
  )
  parser.add_argument(
    "--resolutions", nargs="+", choices=RESOLUTIONS, default=list(RESOLUTIONS)
  )
  parser.add_argument(
    "--batch", type=int, nargs="+", default=[1, 8, 16, 32, 64, 128, 256]
  )
  parser.add_argument("--outputs", nargs="+", default=["rgb"])
  parser.add_argument(
    "--casters", nargs="*", default=[], help="geoms that throw shadows on the table"
  )
  return parser


def _make_pair(
  model: mujoco.MjModel,
  cameras: dict[str, tuple[int, int]],
  casters: list[str],
  outputs: list[str],
) -> Callable:
  """A function from the poses of a batch to the images of both cameras."""
  geoms = Geoms.from_model(model)
  specs = [
    CameraSpec.from_model(model, name, height=height, width=width)
    for name, (height, width) in cameras.items()
  ]
  lighting = Lighting.from_model(
    model,
    shadow_casters=tuple(model.geom(name).id for name in casters),
    shadow_receivers=(model.geom("table").id,),
  )

  def pair(geom_xpos, geom_xmat, cam_xpos, cam_xmat):
    return [
      render(
        geoms,
        camera,
        geom_xpos,
        geom_xmat,
        cam_xpos[:, camera.id],
        cam_xmat[:, camera.id],
        lighting,
        outputs=tuple(outputs),
      )
      for camera in specs
    ]

  return pair


def _poses(model: mujoco.MjModel, size: int) -> list[jax.Array]:
  """Poses of geoms and cameras with the arm about its working posture."""
  data, rng = mujoco.MjData(model), np.random.default_rng(0)
  batch = []
  for _ in range(size):
    mujoco.mj_resetData(model, data)
    data.qpos[:6] = [0.0, -1.2, 1.9, -2.2, -1.57, 0.0] + rng.normal(size=6) * 0.2
    mujoco.mj_forward(model, data)
    arrays = (data.geom_xpos, data.geom_xmat, data.cam_xpos, data.cam_xmat)
    batch.append([a.copy() for a in arrays])
  shapes = ((-1, 3), (-1, 3, 3), (-1, 3), (-1, 3, 3))
  return [
    jnp.asarray(np.stack(a).reshape(size, *shape), jnp.float32)
    for a, shape in zip(zip(*batch, strict=True), shapes, strict=True)
  ]


if __name__ == "__main__":
  main()
