"""Camera pairs per second of the ray caster on push_plate, by batch and resolution.

  python benchmarks/render.py --quick
  python benchmarks/render.py --store     # keeps the table in docs/performance.md

A pair is one image of "global" and one of "wrist" of the same world. MuJoCo's software
rendering and PyBullet's TinyRenderer are timed in the same run, where they are
installed. Compilation is timed apart. Each figure is the median over repeats, with the
lowest and the highest; CPU seconds per pair tell how much other work on the machine
disturbed the wall clock. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import statistics
import time

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
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
OTHERS = {
  "mujoco_egl": "MuJoCo, EGL",
  "mujoco_osmesa": "MuJoCo, OSMesa",
  "pybullet_tiny": "PyBullet, TinyRenderer",
}
SECONDS = 0.5  # of work per repeat


def main() -> None:
  args = _arguments()
  model = mujoco.MjModel.from_xml_path(str(SCENE))
  resolutions = {name: RESOLUTIONS[name] for name in args.resolutions}
  sizes = args.batch or ([1, 16] if args.quick else [1, 8, 16, 32, 64, 128, 256])
  repeats = 3 if args.quick else args.repeats
  report = {
    "benchmark": "render",
    "scene": SCENE.stem,
    "geoms": len(Geoms.from_model(model).ids),
    "resolutions": resolutions,
    "outputs": args.outputs,
    "shadow_casters": args.casters,
    **tables.machine(),
    "repeats": repeats,
    "results": [],
    "others": {},
  }
  if not args.json:
    print({k: v for k, v in report.items() if k != "results"})
  for name, cameras in resolutions.items():
    report["others"][name] = {} if args.alone else measure_others(SCENE, cameras)
    if not args.json:
      print(name, report["others"][name], flush=True)
    pair = _make_pair(model, cameras, args.casters, args.outputs)
    for size in sizes:
      result = _measure(pair, _poses(model, size), size, repeats)
      report["results"].append({"resolution": name, **result})
      if not args.json:
        print(
          "batch {batch:4d}: {pairs_per_s:8.0f} pairs/s "
          "[{pairs_per_s_low:.0f}, {pairs_per_s_high:.0f}], {cpu_us_per_pair:.0f} CPU "
          "us/pair, compile {compile_s:.1f} s".format(**result),
          flush=True,
        )
  if args.json:
    print(json.dumps(report))
  if args.store:
    tables.store("render", report)
    _write(report)


def _write(report: dict) -> None:
  """The table in docs/performance.md."""
  resolutions = report["resolutions"]
  rates: dict[str, dict[str, float]] = {}
  for result in report["results"]:
    label = f"ray caster, batch {result['batch']}"
    rates.setdefault(label, {})[result["resolution"]] = result["pairs_per_s"]
  for name, label in OTHERS.items():
    rates[label] = {
      resolution: found.get(name, {}).get("pairs_per_s", "-")
      for resolution, found in report["others"].items()
    }
  head = ["pairs/s", *(_sizes(cameras) for cameras in resolutions.values())]
  rows = [
    (label, *(rate[name] for name in resolutions)) for label, rate in rates.items()
  ]
  note = f"{report['scene']}, {report['device']}, {report['cores']} cores."
  tables.put("render", f"{note}\n\n{tables.table(head, rows)}")


def _sizes(cameras: dict[str, tuple[int, int]]) -> str:
  return " + ".join(f"{height}x{width}" for height, width in cameras.values())


def _arguments() -> argparse.Namespace:
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--json", action="store_true", help="print one JSON object")
  parser.add_argument("--quick", action="store_true", help="two sizes, three repeats")
  parser.add_argument("--store", action="store_true", help="keep JSON and table")
  parser.add_argument(
    "--alone", action="store_true", help="without the other renderers"
  )
  parser.add_argument(
    "--resolutions", nargs="+", choices=RESOLUTIONS, default=list(RESOLUTIONS)
  )
  parser.add_argument("--batch", type=int, nargs="+", help="batch sizes")
  parser.add_argument("--repeats", type=int, default=7)
  parser.add_argument("--outputs", nargs="+", default=["rgb"])
  parser.add_argument(
    "--casters", nargs="*", default=[], help="geoms that throw shadows on the table"
  )
  return parser.parse_args()


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


def _measure(pair: Callable, poses: list, size: int, repeats: int) -> dict:
  """Compiles and times; a repeat runs as often as fills ``SECONDS``."""
  start = time.perf_counter()
  compiled = jax.jit(pair).lower(*poses).compile()
  compile_s = time.perf_counter() - start
  jax.block_until_ready(compiled(*poses))
  start = time.perf_counter()
  jax.block_until_ready(compiled(*poses))
  calls = max(1, round(SECONDS / (time.perf_counter() - start)))
  wall, cpu = [], []
  for _ in range(repeats):
    start, start_cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
      images = compiled(*poses)
      jax.block_until_ready(images)
    wall.append((time.perf_counter() - start) / (calls * size))
    cpu.append((time.process_time() - start_cpu) / (calls * size))
  return {
    "batch": size,
    "pairs_per_s": 1.0 / statistics.median(wall),
    "pairs_per_s_low": 1.0 / max(wall),
    "pairs_per_s_high": 1.0 / min(wall),
    "cpu_us_per_pair": 1e6 * statistics.median(cpu),
    "compile_s": compile_s,
  }


if __name__ == "__main__":
  main()
