"""Pictures that compare a real view with the simulated one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from apnpql_jax.atomic import replacing
from apnpql_jax.config import files
from apnpql_jax.robot import images
from apnpql_jax.robot.calibration.lenses import Lens
from apnpql_jax.robot.vendors import opencv
from apnpql_jax.sim.graphics import View

Json = dict[str, Any]

HEIGHT = 360  # pixels of each picture
EDGE = (255, 90, 0)
CORNER = (0, 200, 60)
_FLIP = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes to OpenGL's
_BACKGROUND = 0.3  # ambient light


def write(
  path: Path,
  camera: Json,
  name: str,
  pose: np.ndarray,
  lens: Lens,
  image: np.ndarray,
  joints: np.ndarray,
  corners: np.ndarray,
) -> None:
  """Writes a real view, the simulated one, and the edges of the latter on the former.

  Both have the field of view of the policy.

  Args:
    path: PNG file to write.
    camera: The camera in the contract.
    name: Its name.
    pose: Its pose in the world f64[4, 4] at this view.
    lens: Its lens.
    image: The real view u8[H, W, 3].
    joints: Joint angles f64[6].
    corners: Corners of the board in the world f64[n, 3], m.

  Raises:
    ConfigError: No graphics library can be loaded.
    DeviceError: The camera sees less than the policy needs.
  """
  from PIL import Image

  cv2 = opencv()
  width = round(HEIGHT * camera["width"] / camera["height"])
  focal = 0.5 * HEIGHT / math.tan(math.radians(camera["vertical_fov_deg"]) / 2)
  center = 0.5 * (width - 1), 0.5 * (HEIGHT - 1)
  plain = Lens(HEIGHT, width, focal, focal, *center)
  view = {**camera, "height": HEIGHT, "width": width}
  view["intrinsics_px"] = {x: getattr(plain, x) for x in ("fx", "fy", "cx", "cy")}
  real = images.Preparation(lens.to_json(), view)(np.ascontiguousarray(image))
  simulated = np.ascontiguousarray(_simulated(camera, name, pose, joints, width))
  edges = cv2.Canny(cv2.cvtColor(simulated, cv2.COLOR_RGB2GRAY), 40, 120) > 0
  both = real.copy()
  both[edges] = EDGE
  inverse = np.linalg.inv(pose)
  points = corners @ inverse[:3, :3].T + inverse[:3, 3]
  for view in (simulated, both):
    for x, y in plain.project(points[points[:, 2] > 0]):
      if 0 <= x < width and 0 <= y < HEIGHT:
        cv2.circle(view, (round(x), round(y)), 3, CORNER, 1, cv2.LINE_AA)
  with replacing(path) as part:
    Image.fromarray(np.concatenate([real, simulated, both], axis=1)).save(part)


def _simulated(
  camera: Json, name: str, pose: np.ndarray, joints: np.ndarray, width: int
) -> np.ndarray:
  """Returns the view of robot and table u8[HEIGHT, width, 3] from a pose."""
  included = files.mjcf_files()
  spec = mujoco.MjSpec.from_string(included["arena.xml"].decode(), include=included)
  model = spec.compile()
  data = mujoco.MjData(model)
  data.qpos[: len(joints)] = joints
  mujoco.mj_kinematics(model, data)
  index = model.camera(name).id
  body = model.cam_bodyid[index]
  mat = data.xmat[body].reshape(3, 3)
  model.cam_pos[index] = mat.T @ (pose[:3, 3] - data.xpos[body])
  turn = mat.T @ pose[:3, :3] @ _FLIP
  mujoco.mju_mat2Quat(model.cam_quat[index], turn.ravel())
  model.cam_fovy[index] = camera["vertical_fov_deg"]
  model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = _BACKGROUND, 0
  model.vis.quality.offsamples = 4
  mujoco.mj_forward(model, data)
  with View(model, HEIGHT, width, shadows=False) as view:
    return view.draw(data, name)
