"""The live scene of a user's task, whose objects may be meshes."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from apnpql_jax.config.files import mjcf_path
from apnpql_jax.render import Geoms
from apnpql_jax.sim.scene import Scene, load_scene
from apnpql_jax.viewing import shapes
from apnpql_jax.viewing.frame import Frame, ToolPath

MESHES = {
  "wedge": 'vertex="0 0 0 0.3 0 0 0 0.2 0 0.3 0.2 0 0 0 0.1 0 0.2 0.2"',
  "tile": 'vertex="0 0 0 0.2 0 0 0.2 0.1 0 0 0.1 0" face="0 1 2 0 2 3"',
}


@pytest.fixture
def scene(tmp_path) -> Scene:
  assets = "".join(
    f'<mesh name="{name}" {shape} inertia="shell"/>' for name, shape in MESHES.items()
  )
  geoms = "".join(
    f'''<geom name="{name}" type="mesh" mesh="{name}" pos="0.8 {y} 0.2" contype="0"
      conaffinity="0"/>'''
    for y, name in enumerate(MESHES)
  )
  path = tmp_path / "workshop.xml"
  path.write_text(
    f"""<mujoco><include file="{mjcf_path("arena")}"/><asset>{assets}</asset>
      <worldbody>{geoms}</worldbody></mujoco>"""
  )
  return load_scene(path)


def hulls_of(scene: Scene) -> dict[str, np.ndarray]:
  """Returns the corners f64[n, 3] of each mesh, m."""
  drawn = Geoms.from_model(scene.model)
  rows = {scene.model.geom(int(drawn.ids[row])).name: row for row in drawn.hulls}
  sizes = scene.model.geom_size[drawn.ids]
  return {name: shapes.corners(drawn.hulls[k], sizes[k]) for name, k in rows.items()}


def test_a_mesh_has_the_corners_of_its_hull(scene):
  vertices = scene.model.mesh_vert.astype(float)
  start = scene.model.mesh_vertadr[scene.model.mesh("wedge").id]
  expected = vertices[start : start + scene.model.mesh("wedge").vertnum[0]]
  found = hulls_of(scene)["wedge"]
  assert ConvexHull(found).volume == pytest.approx(ConvexHull(expected).volume)
  np.testing.assert_allclose(found.min(0), expected.min(0), atol=1e-6)
  np.testing.assert_allclose(found.max(0), expected.max(0), atol=1e-6)


def test_a_flat_mesh_is_a_thin_tile(scene):
  extents = np.sort(np.ptp(hulls_of(scene)["tile"], axis=0))
  np.testing.assert_allclose(extents, [2e-4, 0.1, 0.2], atol=1e-6)


def test_the_live_view_shows_them(scene):
  viser = pytest.importorskip("viser")
  from apnpql_jax.viewing.live_scene import LiveScene

  with socket.create_server(("127.0.0.1", 0)) as listener:
    port = listener.getsockname()[1]
  server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
  try:
    live = LiveScene(server, scene)
    live.show(frame_of(scene))
    nodes = {node.name: node for node in live._geoms}
    for name, corners in hulls_of(scene).items():
      geom = scene.id("geom", name)
      drawn = nodes[f"/scene/{geom}"].vertices
      np.testing.assert_allclose(drawn.max(0), corners.max(0), atol=1e-6)
  finally:
    server.stop()


def frame_of(scene: Scene) -> Frame:
  """Returns an instant of the scene as it is compiled."""
  data = mujoco.MjData(scene.model)
  mujoco.mj_forward(scene.model, data)
  poses: Any = SimpleNamespace(fields={}, geom_xpos=data.geom_xpos)
  poses.geom_xmat = data.geom_xmat.reshape(-1, 3, 3)
  poses.site_xpos, poses.site_xmat = data.site_xpos, data.site_xmat.reshape(-1, 3, 3)
  return Frame(
    episode=1,
    time_s=0.0,
    period_s=0.15,
    checkpoint=None,
    solved=False,
    last=False,
    action=np.zeros(7),
    tool_paths=(ToolPath(np.zeros((2, 3)), np.eye(3), 0.0),) * 3,
    stage=0,
    explanation=None,
    images={},
    poses=poses,
  )
