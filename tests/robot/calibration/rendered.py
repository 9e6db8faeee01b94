"""Photos of a board by simulated cameras, with what MuJoCo has as their truth."""

from __future__ import annotations

from collections.abc import Generator, Sequence
import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np
from PIL import Image
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from apnpql_jax.config import files
from apnpql_jax.errors import ConfigError
from apnpql_jax.robot.arm_model import ArmModel
from apnpql_jax.robot.calibration.boards import Board, _charuco
from apnpql_jax.robot.calibration.lenses import Lens
from apnpql_jax.sim.graphics import View

HEIGHT, WIDTH = 432, 768
NEUTRAL = np.array([-1.6, -1.7, 2.2, -2.1, -1.57, 0.0])
FLIP = np.diag([1.0, -1.0, -1.0])  # OpenGL's camera axes to OpenCV's
THICKNESS = 0.004


def pose(pos: Any, mat: Any) -> np.ndarray:
  found = np.eye(4)
  found[:3, :3], found[:3, 3] = np.reshape(mat, (3, 3)), pos
  return found


@dataclasses.dataclass
class Studio:
  """The robot, both cameras and a board on the table or in the hand."""

  board: Board
  on_tool: bool
  model: mujoco.MjModel
  data: mujoco.MjData
  view: View
  arm: ArmModel = dataclasses.field(default_factory=ArmModel)

  def move(self, joints: np.ndarray) -> None:
    """Sets the joint angles f64[6]."""
    self.data.qpos[:6] = joints
    mujoco.mj_forward(self.model, self.data)

  def flange(self) -> np.ndarray:
    """Returns the pose of the flange in the world."""
    site = self.data.site("attachment_site")
    return pose(site.xpos, site.xmat)

  def camera(self, name: str) -> np.ndarray:
    """Returns the pose of a camera's optical frame in the world."""
    index = self.model.camera(name).id
    mat = self.data.cam_xmat[index].reshape(3, 3) @ FLIP
    return pose(self.data.cam_xpos[index], mat)

  def truth(self, name: str) -> np.ndarray:
    """Returns what a calibration of a camera finds."""
    if name == "global":
      return self.camera(name)
    return np.linalg.inv(self.flange()) @ self.camera(name)

  def lens(self, name: str, distortion: Sequence[float] = (0.0,) * 5) -> Lens:
    """Returns the lens of a camera's photos."""
    fovy = np.radians(self.model.cam_fovy[self.model.camera(name).id])
    focal = 0.5 * HEIGHT / np.tan(0.5 * fovy)
    center = 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)
    return Lens(HEIGHT, WIDTH, focal, focal, *center, tuple(distortion))

  def photo(
    self, name: str, rng: np.random.Generator, distortion: Sequence[float] = ()
  ) -> np.ndarray:
    """Returns a photo with blur and noise, and with distortion if one is given."""
    image = self.view.draw(self.data, name)
    if distortion:
      lens = self.lens(name, distortion)
      grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1)
      ideal = cv2.undistortPoints(
        grid.reshape(-1, 1, 2).astype(np.float64),
        lens.matrix,
        np.array(distortion),
        P=lens.matrix,
      )
      ideal = ideal.reshape(HEIGHT, WIDTH, 2).astype(np.float32)
      image = cv2.remap(image, ideal, None, cv2.INTER_LINEAR)
    image = cv2.GaussianBlur(image, (0, 0), 0.7).astype(np.float32)
    noise = rng.normal(size=image.shape) * (2.0 + 0.02 * image)
    return (image + noise).clip(0, 255).astype(np.uint8)

  def reach(self, flange: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Returns joint angles that reach a pose of the flange, or None."""

    def error(joints: np.ndarray) -> np.ndarray:
      pos, mat = self.arm.flange_pose(joints)
      turn = Rotation.from_matrix(flange[:3, :3] @ mat.T).as_rotvec()
      return np.concatenate([pos - flange[:3, 3], 0.3 * turn])

    for _ in range(8):
      start = NEUTRAL + rng.normal(scale=0.6, size=6)
      found = least_squares(error, start, bounds=(-6.2, 6.2), max_nfev=60)
      if found.cost < 1e-12:
        return found.x
    return None


@contextlib.contextmanager
def studio(board: Board, *, on_tool: bool, scale: float = 1.0) -> Generator[Studio]:
  """Makes the scene; ``scale`` is that of a printer that does not print at 100 %."""
  included = dict(files.mjcf_files())
  spec = mujoco.MjSpec.from_string(included["arena.xml"].decode(), include=included)
  pixels = _charuco(board).generateImage((board.columns * 100, board.rows * 100))
  margin = 20
  pixels = np.pad(pixels, margin, constant_values=255)
  grow = scale * board.square_mm / 1e5  # m per pixel
  height, width = (grow * x for x in pixels.shape)
  # Rows of an image begin at its upper edge, at v = 1.
  spec.add_texture(
    name="board",
    type=mujoco.mjtTexture.mjTEXTURE_2D,
    builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
    width=pixels.shape[1],
    height=pixels.shape[0],
    nchannel=3,
  )
  material = spec.add_material(name="board", specular=0.1)
  material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
  # The board's frame is x right, y down, z into it; its origin is the first corner.
  edge = grow * margin
  grid = [[x, y, z] for z in (0, THICKNESS) for y in (0, 1) for x in (0, 1)]
  corners = np.array(grid)
  vertices = corners * [width, height, 1] - [edge, edge, 0]
  spec.add_mesh(
    name="board",
    uservert=vertices.ravel(),
    usertexcoord=corners[:, :2].ravel(),
    userface=np.ravel(
      [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
       [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
    ),
    userfacetexcoord=np.ravel(
      [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
       [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
    ),
  )  # fmt: skip
  middle = np.array([0.5 * (width - 2 * edge), 0.5 * (height - 2 * edge), 0.0])
  if on_tool:  # Gripped at an edge: the normal is the closing direction.
    mat = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    origin, parent = np.array([0.01, 0.005, 0.25]) - mat @ middle, spec.body("gripper")
  else:
    mat = Rotation.from_euler("xz", [180, 20], degrees=True).as_matrix()
    mat = mat @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    origin, parent = np.array([0.5, 0.02, THICKNESS]) - mat @ middle, spec.worldbody
  quat = Rotation.from_matrix(mat).as_quat(scalar_first=True)
  body = parent.add_body(name="board", pos=origin, quat=quat)
  body.add_geom(
    type=mujoco.mjtGeom.mjGEOM_MESH,
    meshname="board",
    material="board",
    rgba=[1, 1, 1, 1],
    contype=0,
    conaffinity=0,
    mass=0.01,
  )
  model = spec.compile()
  start = model.tex_adr[model.texture("board").id]
  model.tex_data[start : start + 3 * pixels.size] = np.repeat(pixels, 3)
  model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.3, 0.1
  model.vis.quality.offsamples = 4
  try:
    view = View(model, HEIGHT, WIDTH, shadows=False)
  except ConfigError as error:
    if "needs EGL or OSMesa" not in str(error):
      raise
    pytest.skip("no graphics library is installed")
  with view:
    made = Studio(board, on_tool, model, mujoco.MjData(model), view)
    made.move(NEUTRAL)
    yield made


def displace(made: Studio, name: str, shift: Any, turn: Any) -> None:
  """Mounts a camera elsewhere: by a shift (m) and a turn (rad) in its optical axes."""
  model, index = made.model, made.model.camera(name).id
  quat = Rotation.from_quat(model.cam_quat[index], scalar_first=True)
  model.cam_pos[index] += quat.apply(FLIP @ np.asarray(shift))
  turned = quat * Rotation.from_rotvec(FLIP @ np.asarray(turn))
  model.cam_quat[index] = turned.as_quat(scalar_first=True)
  made.move(made.data.qpos[:6].copy())


def postures(made: Studio, name: str, count: int, *, seed: int = 0) -> np.ndarray:
  """Returns joint angles f64[count, 6] at which a camera sees the board."""
  rng = np.random.default_rng(seed)
  lens, found = made.lens(name), []
  body = made.data.body("board")
  relative = pose(body.xpos, body.xmat)
  if made.on_tool:
    relative = np.linalg.inv(made.flange()) @ relative
  middle = np.append(made.board.corners.mean(0), 1.0)
  for _ in range(60 * count):
    # Where the board appears to the camera: in front of it, tilted and turned.
    turn = Rotation.from_euler("xyz", rng.uniform([-0.6, -0.6, -2], [0.6, 0.6, 2]))
    near, far = (0.5, 0.75) if name == "global" else (0.3, 0.5)
    where = pose(np.zeros(3), turn.as_matrix())
    target = np.append(rng.uniform(-0.1, 0.1, 2), 1.0) * rng.uniform(near, far)
    where[:3, 3] = target - (where @ middle)[:3]
    if name == "global":
      flange = made.camera(name) @ where @ np.linalg.inv(relative)
    else:
      flange = relative @ np.linalg.inv(where) @ np.linalg.inv(made.truth(name))
    if flange[2, 3] < 0.15 or np.linalg.norm(flange[:3, 3]) > 0.85:
      continue
    pixels = lens.project(made.board.corners @ where[:3, :3].T + where[:3, 3])
    if (pixels < 30).any() or (pixels > np.array([WIDTH, HEIGHT]) - 30).any():
      continue
    joints = made.reach(flange, rng)
    if joints is not None:
      found.append(joints)
    if len(found) == count:
      return np.array(found)
  raise AssertionError(f"only {len(found)} postures")


def write_views(
  folder: Path,
  made: Studio,
  name: str,
  joints: np.ndarray,
  *,
  serial: str = "1234",
  distortion: Sequence[float] = (),
  lens: bool = True,
) -> Path:
  """Writes a folder of recorded views, as ``docs/calibration.md`` describes it."""
  folder.mkdir(parents=True)
  about: dict[str, Any] = {"serial": serial}
  if lens:
    about["lens"] = made.lens(name, distortion or (0.0,) * 5).to_json()
  (folder / "camera.json").write_text(json.dumps(about))
  rng = np.random.default_rng(1)
  for i, angles in enumerate(joints):
    made.move(angles)
    Image.fromarray(made.photo(name, rng, distortion)).save(folder / f"{i:03d}.png")
    (folder / f"{i:03d}.json").write_text(json.dumps({"joints": angles.tolist()}))
  return folder
