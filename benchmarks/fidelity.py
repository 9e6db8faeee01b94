"""The ray caster against MuJoCo's renderer on random states of every scene.

  python benchmarks/fidelity.py --store

Segmentation and depth of both cameras. ``--store`` keeps the JSON in results, and the
worst image of every scene in docs/images/fidelity.png: our image, our segmentation,
MuJoCo's, and where they differ. Where MuJoCo cannot draw, its rays are the measure.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import imageio.v3 as iio
import mujoco
import numpy as np
import tables

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import CameraSpec, Geoms, Image, Lighting, render
from apnpql_jax.tasks import Task, make_task, task_names

sys.path.append(str(tables.ROOT / "tests"))
import render_oracles  # noqa: E402  (the oracle that the tests use)

CAMERAS = {"global": EnvConfig().global_size, "wrist": EnvConfig().wrist_size}
SEEN = 20
"""Pixels from which a thing counts for the mean of the overlaps."""
SCALE = 3
"""Enlargement of the images in the picture."""
PICTURE = tables.ROOT / "docs" / "images" / "fidelity.png"


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--states", type=int, default=32, help="of each scene")
  parser.add_argument("--json", action="store_true", help="print one JSON object")
  parser.add_argument("--store", action="store_true", help="keep JSON and picture")
  args = parser.parse_args()
  oracle = render_oracles.available()[-1]
  rows, pictures = [], []
  for name in task_names():
    task = make_task(name)
    model, states = task.scene.model, draw_states(task, args.states)
    for camera, size in CAMERAS.items():
      ours = our_view(model, states, camera, size)
      ids, depth = render_oracles.look(oracle, model, states, camera, *size)
      labels = label(model)
      ours, ids = ours.replace(segmentation=labels[ours.segmentation]), labels[ids]
      row, worst = compare(ours, ids, depth)
      rows.append({"scene": name, "camera": camera, **row})
      if camera == "global":
        pictures.append(picture(ours, ids, worst))
      if not args.json:
        print(rows[-1], flush=True)
  report = {"oracle": oracle, "states": args.states, **tables.machine(), "rows": rows}
  if args.store:
    tables.store("fidelity", report)
    iio.imwrite(PICTURE, np.concatenate(pictures))
  if args.json:
    print(json.dumps(report))


def draw_states(task: Task, count: int) -> np.ndarray:
  """f64[count, n]: states of the scene as it is compiled, with the arm anywhere."""
  rng = np.random.default_rng(0)
  draw = task.sample_resets(rng, 8 * count)
  model = task.scene.model
  data, states = mujoco.MjData(model), []
  for row in np.flatnonzero(draw.variant == 0)[:count]:
    data.qpos[:] = draw.qpos[row]
    data.qpos[task.scene.arm_qpos] += rng.uniform(-0.4, 0.4, 6)
    data.mocap_pos[:], data.mocap_quat[:] = draw.mocap_pos[row], draw.mocap_quat[row]
    mujoco.mj_forward(model, data)
    states.append(render_oracles.get_state(model, data))
  return np.stack(states)


def our_view(
  model: mujoco.MjModel, states: np.ndarray, name: str, size: tuple[int, int]
) -> Image:
  """What the ray caster draws of the states, NumPy."""
  data, poses = mujoco.MjData(model), []
  spec = CameraSpec.from_model(model, name, height=size[0], width=size[1])
  for state in states:
    mujoco.mj_setState(model, data, state, render_oracles.STATE)
    mujoco.mj_forward(model, data)
    arrays = (
      data.geom_xpos,
      data.geom_xmat.reshape(-1, 3, 3),
      data.cam_xpos[spec.id],
      data.cam_xmat[spec.id].reshape(3, 3),
    )
    poses.append([np.array(array, np.float32) for array in arrays])
  batch = [np.stack(parts) for parts in zip(*poses, strict=True)]
  image = render(Geoms.from_model(model), spec, *batch, Lighting.from_model(model))
  return Image(*map(np.asarray, (image.rgb, image.depth, image.segmentation)))


def label(model: mujoco.MjModel) -> np.ndarray:
  """i[ngeom + 1]: what can be told apart; the last is -1, for nothing.

  Geoms of one body and colour are one thing: the boxes of a cup share their tops, where
  any of them may be drawn.
  """
  things = np.column_stack([model.geom_bodyid, model.geom_rgba])
  return np.append(np.unique(things, axis=0, return_inverse=True)[1], -1)


def compare(
  ours: Image, ids: np.ndarray, depth: np.ndarray
) -> tuple[dict[str, Any], int]:
  """Figures of a camera, and the index of the worst image."""
  seen = np.asarray(ours.segmentation)
  same = seen == ids
  overlaps = []
  for view, truth in zip(seen, ids, strict=True):
    for thing in np.unique(truth):
      here, there = view == thing, truth == thing
      if there.sum() >= SEEN:
        overlaps.append((here & there).sum() / (here | there).sum())
  both = same & (ids >= 0)
  error = 1e6 * np.abs(np.asarray(ours.depth)[both] - depth[both])
  figures = {
    "agreeing": float(same.mean()),
    "iou_mean": float(np.mean(overlaps)),
    "iou_least": float(np.min(overlaps)),
    "depth_median_um": float(np.median(error)),
    "depth_p99_um": float(np.quantile(error, 0.99)),
  }
  return figures, int(same.mean((1, 2)).argmin())


def picture(ours: Image, ids: np.ndarray, index: int) -> np.ndarray:
  """u8[H, W, 3]: one state four times, side by side."""
  seen = np.asarray(ours.segmentation)[index]
  colors = np.random.default_rng(1).integers(40, 256, (ids.max() + 2, 3)).astype("u1")
  wrong = np.where((seen != ids[index])[..., None], np.uint8(255), np.uint8(0))
  views = (np.asarray(ours.rgb)[index], colors[seen], colors[ids[index]])
  row = np.concatenate([*views, np.repeat(wrong, 3, axis=-1)], axis=1)
  return row.repeat(SCALE, axis=0).repeat(SCALE, axis=1)


if __name__ == "__main__":
  main()
