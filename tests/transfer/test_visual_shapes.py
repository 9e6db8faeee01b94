"""TinyRenderer's shapes against MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from apnpql_jax.transfer import tiny_renderer


@pytest.mark.parametrize("name", "SPHERE CAPSULE ELLIPSOID CYLINDER BOX".split())
def test_shapes_of_clutter_have_the_silhouettes_of_mujoco(name, tmp_path):
  """Against the distance to the surface along each ray, by MuJoCo."""
  pytest.importorskip("pybullet")
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><worldbody><geom type='{name.lower()}' size='0.04 0.05 0.03' "
    "euler='30 20 10' rgba='1 0 0 1'/></worldbody></mujoco>"
  )
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  geoms = tiny_renderer.Geoms.from_model(model)
  world = tiny_renderer._World(model, geoms, model.geom_size, tmp_path)
  world.place(data.geom_xpos, data.geom_xmat)
  mat = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
  height, width, fovy = 80, 120, 30.0
  eye = np.array([0.0, 0.0, 0.4])
  lighting = {"lightDirection": [0, 0, 1], "shadow": 0}
  seen = world.image((height, width), eye, mat, fovy, lighting)[..., 3] > 0
  slope = np.tan(np.radians(fovy) / 2)
  rows = slope * (1 - 2 * (np.arange(height) + 0.5) / height)
  columns = slope * width / height * (2 * (np.arange(width) + 0.5) / width - 1)
  expected = np.zeros((height, width), bool)
  for i, y in enumerate(rows):
    for j, x in enumerate(columns):
      ray = np.array([x, y, -1.0])
      hit = np.array([-1], np.int32)
      expected[i, j] = mujoco.mj_ray(model, data, eye, ray, None, 1, -1, hit) >= 0
  world.client.disconnect()
  assert expected.sum() > 500
  assert (seen == expected).mean() > 0.97
