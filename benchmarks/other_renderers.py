"""Pairs of camera images per second of MuJoCo's renderer and PyBullet's TinyRenderer.

Used by render.py. Each draws one state at a time, as both can do no other, in a process
of its own: the choice of graphics library belongs to the first import of MuJoCo, and a
missing one may take the interpreter down.
"""

from __future__ import annotations

from collections.abc import Callable
import itertools
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
from typing import Any

import mujoco
import numpy as np
import sides

STATES = 8
SECONDS = 1.0
"""Of work per repeat."""


def measure_others(
  scene: Path, cameras: dict[str, tuple[int, int]], *, repeats: int
) -> dict[str, dict[str, Any]]:
  """Pairs per second by renderer, or one line that says why there is no figure.

  Args:
    scene: MJCF file.
    cameras: height and width by name.
    repeats: how often each is timed.
  """
  found = {}
  for name, env in (
    ("mujoco_egl", {"MUJOCO_GL": "egl"}),
    ("mujoco_osmesa", {"MUJOCO_GL": "osmesa"}),
    ("pybullet_tiny", {}),
  ):
    inputs = (name, str(scene), json.dumps(cameras), str(repeats))
    command = [sys.executable, __file__, *inputs]
    done = subprocess.run(
      command, env=os.environ | env, capture_output=True, text=True, check=False
    )
    lines = done.stdout.splitlines()
    if done.returncode == 0 and lines:
      found[name] = json.loads(lines[-1])
    else:
      reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[
        -1
      ]
      found[name] = {"missing": reason}
  return found


def states(model: mujoco.MjModel) -> list[mujoco.MjData]:
  """The arm about its working posture."""
  rng, out = np.random.default_rng(0), []
  for _ in range(STATES):
    data = mujoco.MjData(model)
    data.qpos[:6] = [0.0, -1.2, 1.9, -2.2, -1.57, 0.0] + rng.normal(size=6) * 0.2
    mujoco.mj_forward(model, data)
    out.append(data)
  return out


def mujoco_pair(
  model: mujoco.MjModel, cameras: dict[str, tuple[int, int]]
) -> Callable[[mujoco.MjData], Any]:
  """Draws both images with the graphics library that the environment names."""
  model.vis.quality.offsamples = model.vis.quality.shadowsize = 0
  renderers = {name: mujoco.Renderer(model, *size) for name, size in cameras.items()}

  def pair(data: mujoco.MjData) -> list[np.ndarray]:
    images = []
    for name, renderer in renderers.items():
      renderer.update_scene(data, name)
      images.append(renderer.render())
    return images

  return pair


def pybullet_pair(
  model: mujoco.MjModel, cameras: dict[str, tuple[int, int]]
) -> Callable[[mujoco.MjData], Any]:
  """Draws both images of the same geoms, moved to where they are."""
  import pybullet

  pybullet.connect(pybullet.DIRECT)
  visible = np.flatnonzero((model.geom_rgba[:, 3] > 0) & (model.geom_group < 3))
  bodies = {int(i): _bullet_body(pybullet, model, int(i)) for i in visible}

  def pair(data: mujoco.MjData) -> list[Any]:
    for geom, body in bodies.items():
      quat = np.zeros(4)
      mujoco.mju_mat2Quat(quat, data.geom_xmat[geom])
      pybullet.resetBasePositionAndOrientation(
        body, data.geom_xpos[geom], np.roll(quat, -1)
      )
    return [
      pybullet.getCameraImage(
        width,
        height,
        _view(pybullet, model, data, name),
        pybullet.computeProjectionMatrixFOV(
          model.cam_fovy[model.camera(name).id], width / height, 0.01, 5.0
        ),
        renderer=pybullet.ER_TINY_RENDERER,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
      )[2]
      for name, (height, width) in cameras.items()
    ]

  return pair


def _bullet_body(pybullet: Any, model: mujoco.MjModel, geom: int) -> int:
  kinds, size = mujoco.mjtGeom, model.geom_size[geom].tolist()
  shape = {
    kinds.mjGEOM_PLANE: {"shapeType": pybullet.GEOM_BOX, "halfExtents": [2, 2, 1e-3]},
    kinds.mjGEOM_SPHERE: {"shapeType": pybullet.GEOM_SPHERE, "radius": size[0]},
    kinds.mjGEOM_CAPSULE: {
      "shapeType": pybullet.GEOM_CAPSULE,
      "radius": size[0],
      "length": 2 * size[1],
    },
    kinds.mjGEOM_CYLINDER: {
      "shapeType": pybullet.GEOM_CYLINDER,
      "radius": size[0],
      "length": 2 * size[1],
    },
    kinds.mjGEOM_BOX: {"shapeType": pybullet.GEOM_BOX, "halfExtents": size},
  }[kinds(int(model.geom_type[geom]))]
  color = model.geom_rgba[geom].tolist()
  visual = pybullet.createVisualShape(**shape, rgbaColor=color)
  return pybullet.createMultiBody(baseVisualShapeIndex=visual)


def _view(pybullet: Any, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Any:
  index = model.camera(name).id
  position, mat = data.cam_xpos[index], data.cam_xmat[index].reshape(3, 3)
  return pybullet.computeViewMatrix(position, position - mat[:, 2], mat[:, 1])


PAIRS = {
  "mujoco_egl": mujoco_pair,
  "mujoco_osmesa": mujoco_pair,
  "pybullet_tiny": pybullet_pair,
}


def main(name: str, scene: str, cameras: str, repeats: str) -> None:
  """Prints the figures of one renderer as JSON."""
  model = mujoco.MjModel.from_xml_path(scene)
  pair, worlds = PAIRS[name](model, json.loads(cameras)), states(model)
  pair(worlds[0])
  turn = itertools.cycle(worlds)
  rate = sides.rate_of(lambda: pair(next(turn)), 1)
  rates = [rate(SECONDS) for _ in range(int(repeats))]
  figures = {"": statistics.median(rates), "_low": min(rates), "_high": max(rates)}
  print(json.dumps({f"pairs_per_s{end}": x for end, x in figures.items()}), flush=True)


if __name__ == "__main__":
  main(*sys.argv[1:])
