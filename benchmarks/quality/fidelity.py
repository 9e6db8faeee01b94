"""The ray caster against MuJoCo's renderer on random states of every scene.

  python -m benchmarks.quality.fidelity --store

Compares segmentation and depth of both cameras. ``--store`` also writes the worst
global image of every scene to docs/images/fidelity.png: our image, our segmentation,
MuJoCo's, and their difference. Where MuJoCo cannot draw, its rays replace its
rasterizer.
"""

from collections.abc import Iterator
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import CameraSpec, Geoms, Image, Lighting, render
from apnpql_jax.tasks import Task, make_task, task_names
from benchmarks.common import command, store
from tests import render_oracles

CAMERAS = {"global": EnvConfig().global_size, "wrist": EnvConfig().wrist_size}
SEEN, SCALE = 20, 3
"""Pixels from which an object counts for the overlaps; enlargement of the picture."""
PICTURE = store.ROOT / "docs" / "images" / "fidelity.png"


def main() -> None:
  parser = command.parser(__doc__)
  parser.add_argument("--states", type=int, default=32, help="of each scene")
  args = command.parse(parser)
  args.states = 1 if args.quick else args.states
  oracle, pictures = render_oracles.available()[-1], []
  results = measure_all(oracle, args.states, pictures)
  command.publish("fidelity", args, results, oracle=oracle, states=args.states)
  if args.store:
    iio.imwrite(PICTURE, np.concatenate(pictures))


def measure_all(oracle: str, count: int, pictures: list) -> Iterator[dict[str, Any]]:
  """Yields the figures of each scene and camera; adds to the pictures."""
  for name in task_names():
    task = make_task(name)
    model, states = task.scene.model, draw_states(task, count)
    labels = label(model)
    for camera, size in CAMERAS.items():
      ours = our_view(model, states, camera, size)
      ids, depth = render_oracles.look(oracle, model, states, camera, *size)
      ours, ids = ours.replace(segmentation=labels[ours.segmentation]), labels[ids]
      yield {"scene": name, "camera": camera, **compare(ours, ids, depth)}
      if camera == "global":
        pictures.append(picture(ours, ids))


def draw_states(task: Task, count: int) -> np.ndarray:
  """Draws states f64[count, n] of the compiled scene with the arm moved at random."""
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


def our_view(model: Any, states: np.ndarray, name: str, size: tuple[int, int]) -> Image:
  """Renders the states with the ray caster, as NumPy arrays."""
  data, poses = mujoco.MjData(model), []
  spec = CameraSpec.from_model(model, name, height=size[0], width=size[1])
  for state in states:
    mujoco.mj_setState(model, data, state, render_oracles.STATE)
    mujoco.mj_forward(model, data)
    geoms = (data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))
    camera = (data.cam_xpos[spec.id], data.cam_xmat[spec.id].reshape(3, 3))
    poses.append([np.array(array, np.float32) for array in (*geoms, *camera)])
  batch = [np.stack(parts) for parts in zip(*poses, strict=True)]
  image = render(Geoms.from_model(model), spec, *batch, Lighting.from_model(model))
  return Image(*map(np.asarray, (image.rgb, image.depth, image.segmentation)))


def label(model: mujoco.MjModel) -> np.ndarray:
  """Labels geoms, i[ngeom + 1], by body and color; the last label is -1, for nothing.

  The boxes of a cup share their tops, where any of them may be drawn.
  """
  things = np.column_stack([model.geom_bodyid, model.geom_rgba])
  return np.append(np.unique(things, axis=0, return_inverse=True)[1], -1)


def compare(ours: Image, ids: np.ndarray, depth: np.ndarray) -> dict[str, float]:
  """Returns the figures of a camera."""
  seen, overlaps = np.asarray(ours.segmentation), []
  for view, truth in zip(seen, ids, strict=True):
    for thing in np.unique(truth):
      here, there = view == thing, truth == thing
      if there.sum() >= SEEN:
        overlaps.append((here & there).sum() / (here | there).sum())
  both = (seen == ids) & (ids >= 0)
  error_um = 1e6 * np.abs(np.asarray(ours.depth)[both] - depth[both])
  return {
    "agreeing": float((seen == ids).mean()),
    "iou_mean": float(np.mean(overlaps)),
    "iou_least": float(np.min(overlaps)),
    "depth_median_um": float(np.median(error_um)),
    "depth_p99_um": float(np.quantile(error_um, 0.99)),
  }


def picture(ours: Image, ids: np.ndarray) -> np.ndarray:
  """Returns four views of the worst state side by side, u8[H, W, 3]."""
  seen = np.asarray(ours.segmentation)
  worst = (seen == ids).mean((1, 2)).argmin()
  colors = np.random.default_rng(1).integers(40, 256, (ids.max() + 2, 3)).astype("u1")
  wrong = np.where((seen != ids)[worst][..., None], [255] * 3, 0).astype("u1")
  views = (np.asarray(ours.rgb)[worst], colors[seen[worst]], colors[ids[worst]], wrong)
  return np.concatenate(views, axis=1).repeat(SCALE, axis=0).repeat(SCALE, axis=1)


if __name__ == "__main__":
  main()
