"""Meshes and textures of a user's scene: what is drawn, and what is refused."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import ArrayLike
import pytest
import render_oracles

from apnpql_jax.errors import ConfigError
from apnpql_jax.render import CameraSpec, Geoms, Lighting, geoms as geoms_module, render
from apnpql_jax.render.hull import MOST_PLANES, hull_of

HEIGHT, WIDTH = 72, 96


def mesh(name: str, vertices: ArrayLike, faces: ArrayLike | None = None) -> str:
  text = " ".join(map(str, np.ravel(vertices)))
  face = "" if faces is None else f' face="{" ".join(map(str, np.ravel(faces)))}"'
  return f'<mesh name="{name}" vertex="{text}"{face}/>'


def boxes(name: str, *ends: tuple[ArrayLike, ArrayLike]) -> str:
  """Returns a mesh of boxes, given by two corners each."""
  quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6],
                    [0, 2, 6, 4], [1, 5, 7, 3]])  # fmt: skip
  triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
  unit = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
  vertices = np.concatenate([low + unit * np.subtract(high, low) for low, high in ends])
  faces = np.concatenate([triangles + 8 * k for k in range(len(ends))])
  return mesh(name, vertices, faces)


WEDGE = mesh("wedge", [(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0.3, 0.2, 0),
                       (0, 0, 0.1), (0, 0.2, 0.2)])  # fmt: skip
BALL = '<mesh name="ball" builtin="sphere" params="3" scale="0.12 0.09 0.15"/>'
BOWL = boxes(
  "bowl",
  ((0, 0, 0), (0.3, 0.1, 0.03)),
  ((0, 0, 0), (0.03, 0.1, 0.2)),
  ((0.27, 0, 0), (0.3, 0.1, 0.2)),
)


def model_of(assets: str, geoms: str) -> mujoco.MjModel:
  return mujoco.MjModel.from_xml_string(f"""
  <mujoco><asset>{assets}</asset><visual><map znear="0.01"/></visual><worldbody>
    <light directional="true" dir="0.4 -0.2 -1"/>
    <geom name="floor" type="plane" size="2 2 .1" rgba="0.8 0.8 0.7 1"/>{geoms}
    <camera name="eye" pos="0 -1.2 0.7" xyaxes="1 0 0 0 0.32 0.95" fovy="32"/>
  </worldbody></mujoco>""")


def picture(model: mujoco.MjModel, **settings):
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  camera = CameraSpec.from_model(model, "eye", height=HEIGHT, width=WIDTH)
  poses = (
    data.geom_xpos,
    data.geom_xmat.reshape(-1, 3, 3),
    data.cam_xpos[camera.id],
    data.cam_xmat[camera.id].reshape(3, 3),
  )
  poses = tuple(np.array(x, np.float32) for x in poses)
  light = Lighting.from_model(model)
  return data, render(Geoms.from_model(model), camera, *poses, light, **settings)


TURNED = 'pos="-0.15 0 0.3" euler="30 40 50"'


@pytest.mark.parametrize("turn", range(4))
def test_a_convex_mesh_is_drawn_as_it_is(turn):
  geoms = f'<geom name="w" type="mesh" mesh="wedge" euler="{40 * turn} 20 10" '
  model = model_of(WEDGE, geoms + 'pos="0 0 0.3"/>')
  data, image = picture(model)
  ids, depth, normals = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  wedge = model.geom("w").id
  same = np.asarray(image.segmentation) == ids
  assert same.mean() > 0.998 and 200 < (ids == wedge).sum() < 3000
  both = same & (ids == wedge)
  np.testing.assert_allclose(np.asarray(image.depth)[both], depth[both], rtol=1e-4)
  # Flat shading by the formula of ``Lighting``, of the mesh's own normals.
  light = -np.array([0.4, -0.2, -1]) / np.linalg.norm([0.4, -0.2, -1])
  cosine = normals @ light
  expected = 0.35 + 0.65 * np.maximum(cosine, -0.3 * cosine)
  shade = np.asarray(image.rgb)[both][:, 0] / (255 * 0.5)
  assert np.quantile(np.abs(shade - expected[both]), 0.99) < 0.02


def test_a_round_mesh_is_drawn_by_few_planes():
  """They have its volume, and about its outline."""
  model = model_of(BALL, f'<geom name="b" type="mesh" mesh="ball" {TURNED}/>')
  planes, fill = hull_of(model, model.geom("b").id)
  assert len(planes) == MOST_PLANES and fill > 0.99
  data, image = picture(model)
  ids, _, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  ball = model.geom("b").id
  ours, theirs = np.asarray(image.segmentation) == ball, ids == ball
  assert theirs.sum() > 300 and abs(ours.sum() / theirs.sum() - 1) < 0.05
  assert (ours & theirs).sum() / (ours | theirs).sum() > 0.93


def test_a_hull_scales_with_its_geom():
  """As objects do with ``--env.randomize``."""
  model = model_of(WEDGE, '<geom name="w" type="mesh" mesh="wedge" pos="0 0 .3"/>')
  factors = np.array([1.3, 1.3, 0.7])
  size = jnp.asarray(model.geom_size, jnp.float32).at[1].multiply(factors)
  _, image = picture(model, fields={"geom_size": size})
  planes, _ = hull_of(model, model.geom("w").id)
  # MuJoCo's rays at a mesh whose vertices are scaled in the frame of the geom.
  scaled = mesh("wedge", model.mesh_vert * factors)
  where = [" ".join(map(str, x[1])) for x in (model.geom_pos, model.geom_quat)]
  where = f'pos="{where[0]}" quat="{where[1]}"'
  other = model_of(scaled, f'<geom name="w" type="mesh" mesh="wedge" {where}/>')
  data = mujoco.MjData(other)
  mujoco.mj_forward(other, data)
  ids, _, _ = render_oracles.cast_rays(other, data, "eye", HEIGHT, WIDTH)
  assert len(planes) == 6 and (ids == 1).sum() > 200
  assert (np.asarray(image.segmentation) == ids).mean() > 0.998


def test_a_mesh_that_its_hull_does_not_show_is_refused():
  model = model_of(BOWL, '<geom name="bowl" type="mesh" mesh="bowl"/>')
  words = "cannot draw mesh 'bowl': it fills 3[0-9]% of its convex hull.*group.*state"
  with pytest.raises(ConfigError, match=words) as error:
    Geoms.from_model(model)
  assert "\n" not in str(error.value)
  model.geom_group[model.geom("bowl").id] = 3
  assert Geoms.from_model(model).ids.tolist() == [0]


def test_a_flat_mesh_is_drawn_as_its_box():
  corners = [(0, 0, 0), (0.3, 0, 0), (0, 0.2, 0), (0.3, 0.2, 0)]
  flat = mesh("flat", corners, [(0, 1, 3), (0, 3, 2)])
  flat = flat.replace("/>", ' inertia="shell"/>')
  only_seen = 'pos="0 0 .2" contype="0" conaffinity="0"'
  model = model_of(flat, f'<geom name="f" type="mesh" mesh="flat" {only_seen}/>')
  _, image = picture(model)
  assert (np.asarray(image.segmentation) == model.geom("f").id).sum() > 100


@pytest.mark.parametrize(
  ("kind", "builtin", "geom"),
  [
    ("2d", "gradient", 'type="plane" size="1 1 1"'),
    ("2d", "checker", 'type="box" size=".1 .1 .1"'),
    ("cube", "gradient", 'type="mesh" mesh="wedge"'),
  ],
)
def test_other_textures_are_drawn_as_their_mean_color(kind, builtin, geom, capsys):
  geoms_module._print_once.cache_clear()
  assets = f"""{WEDGE}<texture name="t" type="{kind}" builtin="{builtin}"
    rgb1="1 0 0" rgb2="0 1 0" width="32" height="32"/>
    <material name="m" texture="t" rgba="0.5 1 1 1"/>"""
  model = model_of(assets, f'<geom name="g" {geom} material="m"/>')
  for _ in range(2):  # Both cameras read it.
    geoms = Geoms.from_model(model)
  k = geoms.ids.tolist().index(model.geom("g").id)
  mean = model.tex_data.reshape(-1, 3).mean(0) / 255
  assert geoms.checker[k] == 0 and mean[:2].min() > 0.2
  np.testing.assert_allclose(geoms.colors[k], mean * [0.5, 1, 1], atol=1e-6)
  shown = capsys.readouterr().err
  assert shown == "the texture of 'g' is drawn as its mean color\n"
