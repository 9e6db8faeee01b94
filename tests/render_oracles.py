"""Two independent images of a scene: by MuJoCo's rays and by MuJoCo's rasterizer.

The rays need no graphics library. The rasterizer runs this file in a new process: the
first import of MuJoCo fixes the graphics library, and a missing one can crash the
interpreter.
"""

from __future__ import annotations

import functools
import os
from pathlib import Path
import subprocess
import sys
import tempfile

import mujoco
import numpy as np

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def get_state(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
  """Returns everything that the poses of bodies depend on, f64[n]."""
  state = np.zeros(mujoco.mj_stateSize(model, STATE))
  mujoco.mj_getState(model, data, state, STATE)
  return state


def ray_directions(height: int, width: int, fovy_deg: float) -> np.ndarray:
  """Returns unit rays f64[H, W, 3] through the pixel centers in the camera's frame."""
  half = np.tan(np.radians(fovy_deg) / 2)
  out = np.zeros((height, width, 3))
  for row in range(height):
    for column in range(width):
      up = half * (1 - (2 * row + 1) / height)
      right = half * ((2 * column + 1) / width - 1) * width / height
      out[row, column] = (right, up, -1)
  return out / np.linalg.norm(out, axis=-1, keepdims=True)


def cast_rays(
  model: mujoco.MjModel, data: mujoco.MjData, name: str, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns geom ids i32[H, W], depths f64[H, W] and world normals f64[H, W, 3]."""
  camera = model.camera(name).id
  rays = ray_directions(height, width, model.cam_fovy[camera])
  rotation = data.cam_xmat[camera].reshape(3, 3)
  pixels = height * width
  ids = np.zeros(pixels, np.int32)
  distance, normal = np.zeros(pixels), np.zeros(pixels * 3)
  mujoco.mj_multiRay(
    model,
    data,
    data.cam_xpos[camera],
    (rays.reshape(-1, 3) @ rotation.T).reshape(-1),
    np.array([1, 1, 1, 0, 0, 0], np.uint8),  # groups that the rasterizer draws
    True,
    -1,
    ids,
    distance,
    normal,
    pixels,
    mujoco.mjMAXVAL,
  )
  depth = np.where(ids >= 0, distance * -rays[..., 2].reshape(-1), np.inf)
  shape = (height, width)
  return ids.reshape(shape), depth.reshape(shape), normal.reshape(*shape, 3)


def rasterize(
  model: mujoco.MjModel, states: np.ndarray, name: str, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns geom ids i32[n, H, W] and depths f32[n, H, W] by ``mujoco.Renderer``.

  Raises:
    LookupError: No graphics library can be loaded.
  """
  library = _graphics_library()
  if library is None:
    raise LookupError("MuJoCo cannot draw on this machine")
  with tempfile.TemporaryDirectory() as folder:
    path = Path(folder)
    mujoco.mj_saveModel(model, str(path / "model.mjb"), None)
    np.savez(path / "in.npz", states=states, name=name, size=(height, width))
    command = [sys.executable, __file__, folder]
    subprocess.run(command, env=_environment(library), check=True)
    out = np.load(path / "out.npz")
    return out["ids"], out["depth"]


def _environment(library: str) -> dict[str, str]:
  return dict(os.environ, MUJOCO_GL=library)


@functools.lru_cache
def _graphics_library() -> str | None:
  """Returns the first value of MUJOCO_GL with which MuJoCo can draw here."""
  probe = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
with mujoco.Renderer(model, 8, 8) as renderer:
  renderer.update_scene(mujoco.MjData(model))
  renderer.render()
"""
  chosen = os.environ.get("MUJOCO_GL")
  for library in [chosen] if chosen else ["egl", "osmesa", ""]:
    command = [sys.executable, "-c", probe]
    done = subprocess.run(command, env=_environment(library), capture_output=True)
    if done.returncode == 0:
      return library
  return None


def available() -> tuple[str, ...]:
  """Returns the oracles that work on this machine; "rays" always does."""
  return ("rays",) if _graphics_library() is None else ("rays", "rasteriser")


def look(
  oracle: str,
  model: mujoco.MjModel,
  states: np.ndarray,
  name: str,
  height: int,
  width: int,
) -> tuple[np.ndarray, np.ndarray]:
  """Returns geom ids and depths [n, H, W] by an oracle."""
  if oracle == "rasteriser":
    return rasterize(model, states, name, height, width)
  data, views = mujoco.MjData(model), []
  for state in states:
    mujoco.mj_setState(model, data, state, STATE)
    mujoco.mj_forward(model, data)
    views.append(cast_rays(model, data, name, height, width)[:2])
  ids, depth = zip(*views, strict=True)
  return np.stack(ids), np.stack(depth)


def _main(folder: Path) -> None:
  """Renders the inputs that ``rasterize`` wrote to the folder."""
  given = np.load(folder / "in.npz")
  model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))
  # Facets of spheres and cylinders must be finer than the tolerance.
  model.vis.quality.numslices, model.vis.quality.numstacks = 128, 64
  model.vis.quality.offsamples = model.vis.quality.shadowsize = 0
  height, width = given["size"].tolist()
  data, ids, depth = mujoco.MjData(model), [], []
  far = model.vis.map.zfar * model.stat.extent
  with mujoco.Renderer(model, height, width) as renderer:
    for state in given["states"]:
      mujoco.mj_setState(model, data, state, STATE)
      mujoco.mj_forward(model, data)
      renderer.update_scene(data, str(given["name"]))
      renderer.enable_segmentation_rendering()
      ids.append(renderer.render()[..., 0].copy())
      renderer.enable_depth_rendering()
      depth.append(renderer.render().copy())
  depth = np.stack(depth)
  depth[depth > 0.99 * far] = np.inf
  np.savez(folder / "out.npz", ids=np.stack(ids), depth=depth)


if __name__ == "__main__":
  _main(Path(sys.argv[1]))
