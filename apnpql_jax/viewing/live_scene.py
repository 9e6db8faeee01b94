"""The scene of the live view: geoms, and the primitives as ghost hands, in viser."""

from __future__ import annotations

from typing import Any

from matplotlib.colors import to_rgb
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from apnpql_jax.render import Geoms
from apnpql_jax.sim.scene import Scene
from apnpql_jax.types import PRIMITIVES
from apnpql_jax.viewing import shapes
from apnpql_jax.viewing.frame import COLORS, Frame

_KIND = mujoco.mjtGeom
_AMBIENT, _SUN = 1.2, 1.6
"""Intensities at which the colors of the scene file look as in the images."""

_PLANE = 3.0
"""Edge in m of the square that is drawn of a plane."""


class LiveScene:
  """Nodes of a scene in a viser server, moved with every frame."""

  def __init__(self, server: Any, scene: Scene):
    """Adds the light and the camera; the geoms follow with the first frame."""
    self._nodes, self._scene = server.scene, scene
    self._drawn, self._looks = Geoms.from_model(scene.model), b""
    server.scene.set_up_direction("+z")
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(False)
    server.scene.add_light_ambient("/lights/ambient", intensity=_AMBIENT)
    server.scene.add_light_directional(
      "/lights/sun", intensity=_SUN, position=(-0.6, -0.8, 2.0), cast_shadow=True
    )
    _look_from(server.initial_camera, scene)

  def show(self, frame: Frame) -> None:
    """Moves everything to where it is in a frame."""
    sizes, colors = self._appearance(frame)
    looks = sizes.tobytes() + colors.tobytes()
    if looks != self._looks:  # Objects may differ between episodes.
      self._build(frame, sizes, colors)
      self._looks = looks
    ids = self._drawn.ids
    turns = _quaternions(frame.poses.geom_xmat[ids])
    for node, i, turn in zip(self._geoms, ids, turns, strict=True):
      node.position, node.wxyz = frame.poses.geom_xpos[i], turn
    for k, (ghost, way, label) in enumerate(self._ghosts):
      path, share = frame.tool_paths[k], float(frame.shares[k])
      positions = path.positions
      ghost.position, ghost.wxyz = positions[-1], _quaternions(path.mat)
      ghost.opacity = 0.12 + 0.5 * share
      way.points = np.stack([positions[:-1], positions[1:]], axis=1)
      way.thickness = 0.002 + 0.006 * share
      label.position = positions[-1] + [0.0, 0.0, 0.03]
      label.text = f"{PRIMITIVES[k]} {share:.0%}"

  def _appearance(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Returns sizes f[ngeom, 3] and the colors f[n, 3] of the drawn geoms."""
    fields, model = frame.poses.fields, self._scene.model
    sizes = np.asarray(fields.get("geom_size", model.geom_size), np.float32)
    colors = self._drawn.colors
    if "geom_rgba" in fields:
      colors = np.asarray(fields["geom_rgba"])[self._drawn.ids, :3]
    return sizes, colors

  def _build(self, frame: Frame, sizes: np.ndarray, colors: np.ndarray) -> None:
    """Adds all nodes; those of the same name are replaced."""
    drawn = self._drawn
    self._geoms = [
      self._add(row, sizes[i], tuple(color))
      for row, (i, color) in enumerate(zip(drawn.ids, colors.tolist(), strict=True))
    ]
    parts = shapes.GhostHand(self._scene, sizes).parts(frame.poses)
    vertices, faces = _joined([shapes.mesh(part) for part in parts])
    self._ghosts = []
    for name, color in zip(PRIMITIVES, map(to_rgb, COLORS), strict=True):
      ghost = self._nodes.add_mesh_simple(
        f"/primitives/{name}/hand",
        vertices,
        faces,
        color=color,
        opacity=0.5,
        cast_shadow=False,
        receive_shadow=False,
      )
      way = self._nodes.add_line_segments(
        f"/primitives/{name}/way", np.zeros((1, 2, 3)), color, thickness=0.004
      )
      label = self._nodes.add_label(
        f"/primitives/{name}/name", name, font_screen_scale=0.8, anchor="bottom-center"
      )
      self._ghosts.append((ghost, way, label))

  def _add(self, row: int, size: np.ndarray, color: Any) -> Any:
    """Adds a row of ``Geoms``."""
    drawn, add = self._drawn, self._nodes
    name, kind = f"/scene/{drawn.ids[row]}", int(drawn.types[row])
    x, y, z = size.tolist()
    if kind == _KIND.mjGEOM_PLANE:
      vertices = (
        0.5 * _PLANE * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
      )
      faces = np.array([[0, 1, 2], [0, 2, 3]])
      return add.add_mesh_simple(name, vertices, faces, color=color, cast_shadow=False)
    if kind == _KIND.mjGEOM_BOX:
      return add.add_box(name, color=color, dimensions=(2 * x, 2 * y, 2 * z))
    if kind == _KIND.mjGEOM_CYLINDER:
      return add.add_cylinder(name, radius=x, height=2 * y, color=color)
    if kind == _KIND.mjGEOM_SPHERE:
      return add.add_icosphere(name, radius=x, color=color)
    if kind == _KIND.mjGEOM_MESH:
      points = shapes.corners(drawn.hulls[row], size)
    else:
      points = shapes.surface(kind, size)
    return add.add_mesh_simple(name, *shapes.mesh(points), color=color)


def _quaternions(mats: np.ndarray) -> np.ndarray:
  """Returns quaternions wxyz f64[*b, 4] of rotations f[*b, 3, 3]."""
  return Rotation.from_matrix(mats).as_quat(scalar_first=True)


def _joined(
  meshes: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
  """Returns one mesh, vertices and faces, made up of several."""
  counts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
  faces = [faces + start for (_, faces), start in zip(meshes, counts, strict=False)]
  return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _look_from(camera: Any, scene: Scene) -> None:
  """Sets the first view to that of the camera ``wide``, closer to the table."""
  data = mujoco.MjData(scene.model)
  mujoco.mj_kinematics(scene.model, data)
  mujoco.mj_camlight(scene.model, data)
  index = scene.id("camera", "wide")
  eye, ahead = data.cam_xpos[index], -data.cam_xmat[index].reshape(3, 3)[:, 2]
  camera.position, camera.look_at = eye, eye + 1.3 * ahead
  camera.fov = float(np.radians(scene.model.cam_fovy[index]))
