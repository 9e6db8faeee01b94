"""Appearance per world, against models with the same values and against NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import render_oracles

from apnpql_jax.render import CameraSpec, Geoms, Image, Lighting, render

HEIGHT, WIDTH = 48, 64


def _model(*, turn: float = 0.0) -> mujoco.MjModel:
  """Returns a model whose colors, sizes, light and camera depend on one number."""
  xml = f"""
<mujoco><worldbody>
  <light directional="true" dir="{0.4 - turn} -0.2 -1"/>
  <geom type="plane" size="0.5 0.4 0.1" rgba="0.8 {0.8 - turn} 0.7 1"/>
  <geom type="box" size="0.1 {0.12 + 0.2 * turn} 0.05" pos="0 0.2 0.1" euler="20 10 30"
    rgba="0.2 {0.3 + turn} 0.9 1"/>
  <geom type="cylinder" size="0.08 0.1" pos="0.2 -0.2 0.15" euler="40 0 0"
    rgba="{0.9 - turn} 0.3 0.1 1"/>
  <geom type="capsule" size="{0.04 + 0.1 * turn} 0.1" pos="-0.2 -0.1 0.2" euler="0 70 0"
    rgba="0.1 0.8 {0.2 + turn} 1"/>
  <camera name="eye" pos="0.3 -0.2 1.1" euler="10 12 20" fovy="{50 + 40 * turn}"/>
</worldbody></mujoco>"""
  return mujoco.MjModel.from_xml_string(xml)


def _poses(model: mujoco.MjModel) -> list[np.ndarray]:
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  poses = (
    data.geom_xpos,
    data.geom_xmat.reshape(-1, 3, 3),
    data.cam_xpos[0],
    data.cam_xmat[0].reshape(3, 3),
  )
  return [np.asarray(pose, np.float32) for pose in poses]


def _image(model: mujoco.MjModel, fields=None, background=(0.5, 0.6, 0.7)) -> Image:
  return render(
    Geoms.from_model(model),
    CameraSpec.from_model(model, "eye", height=HEIGHT, width=WIDTH),
    *_poses(model),
    Lighting.from_model(model, background=background),
    fields=fields,
  )


def _fields(model: mujoco.MjModel, background) -> dict[str, jax.Array]:
  names = ("geom_rgba", "geom_size", "light_dir", "cam_fovy")
  fields = {name: np.array(getattr(model, name), np.float32) for name in names}
  plain, ones = Lighting(), np.ones((1, 3), np.float32)
  fields |= {
    "light_ambient": plain.ambient * ones,
    "light_diffuse": plain.diffuse * ones,
    "background": np.array(background, np.float32),
    "body_mass": model.body_mass,  # Ignored.
  }
  return {name: jnp.asarray(value, jnp.float32) for name, value in fields.items()}


def _assert_same(image: Image, expected: Image) -> None:
  same = np.asarray(image.segmentation) == np.asarray(expected.segmentation)
  assert same.mean() > 0.998
  np.testing.assert_allclose(
    np.asarray(image.depth)[same], np.asarray(expected.depth)[same], rtol=1e-4
  )
  levels = [np.asarray(x.rgb, np.int32)[same] for x in (image, expected)]
  assert np.abs(levels[0] - levels[1]).max() <= 2


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_fields_equal_a_model_with_these_values(turn):
  """The fields of one model, applied to another, give the image of the first."""
  other, background = _model(turn=turn), (0.3, 0.8 - turn, 0.4)
  image = _image(_model(), _fields(other, background))
  _assert_same(image, _image(other, background=background))


def test_each_world_has_its_own_appearance():
  """A batch of three worlds equals three single images."""
  models = [_model(turn=turn) for turn in (0.0, 0.05, 0.1)]
  fields = [_fields(model, (0.1, 0.2, 0.3)) for model in models]
  together = render(
    Geoms.from_model(models[0]),
    CameraSpec.from_model(models[0], "eye", height=HEIGHT, width=WIDTH),
    *(np.tile(pose, (3, *[1] * pose.ndim)) for pose in _poses(models[0])),
    Lighting.from_model(models[0]),
    fields=jax.tree.map(lambda *x: jnp.stack(x), *fields),
  )
  for world in range(3):
    alone = _image(models[0], fields[world])
    _assert_same(jax.tree.map(lambda x: x[world], together), alone)  # noqa: B023
  assert (together.rgb[0] != together.rgb[2]).any()


def _local_points(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
  """Returns geom ids [H, W] and points [H, W, 3] in the frames of the geoms hit.

  Both come from MuJoCo's rays. A ray without a hit gets its direction as a point: a
  unit vector in the world frame.
  """
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  rays = render_oracles.ray_directions(HEIGHT, WIDTH, model.cam_fovy[0])
  ids, depth, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  ahead = rays @ data.cam_xmat[0].reshape(3, 3).T
  length = np.where(ids >= 0, depth / -rays[..., 2], 1.0)
  start = np.where((ids >= 0)[..., None], data.cam_xpos[0] - data.geom_xpos[ids], 0.0)
  points = start + length[..., None] * ahead
  mats = np.concatenate([data.geom_xmat.reshape(-1, 3, 3), np.eye(3)[None]])[ids]
  return ids, np.einsum("hwji,hwj->hwi", mats, points)


def test_textures_match_numpy_at_the_hit_points():
  """Two geoms have checkers; two others and the background have noise."""
  model, rng = _model(), np.random.default_rng(0)
  waves = np.zeros((5, 3, 4))
  waves[..., 3] = rng.random((5, 3))
  waves[:2, :, :3] = np.eye(3) / [[[0.22]], [[0.09]]]
  waves[0, 2, :3] = 0.0
  waves[2:, :, :3] = rng.normal(size=(3, 3, 3)) * 8
  odd = np.array(
    [[0.1, 0.2, 0.3], [1, 1, 0], [0.9, 0.3, 0.1], [0.1, 0.8, 0.2], [0.9, 0.9, 0.1]]
  )
  grain = np.array([0.0, 0.0, 0.5, 0.8, 0.6])
  fields = {"waves": waves, "odd_rgb": odd, "grain": grain}
  fields = {name: jnp.asarray(value, jnp.float32) for name, value in fields.items()}
  plain, image = _image(model), _image(model, fields)
  np.testing.assert_array_equal(plain.segmentation, image.segmentation)
  np.testing.assert_array_equal(plain.depth, image.depth)

  ids, points = _local_points(model)
  same = ids == np.asarray(image.segmentation)
  turns = np.einsum("hwij,hwj->hwi", waves[ids, :, :3], points) + waves[ids, :, 3]
  is_odd = np.floor(2 * turns).sum(-1) % 2 == 1
  colors = np.concatenate([model.geom_rgba[:, :3], [[0.5, 0.6, 0.7]]])
  factor = np.asarray(plain.rgb) / 256 / colors[ids]  # brightness alone
  color = np.where(is_odd[..., None], odd[ids], colors[ids])
  slope = np.abs(2 * (turns % 1) - 1)
  noise = (slope**2 * (3 - 2 * slope)).mean(-1)
  dim = 1 - grain[ids] * noise
  expected = 256 * color * factor.mean(-1, keepdims=True) * dim[..., None]
  error = np.abs(np.asarray(image.rgb) - expected).max(-1)[same]
  # Pixels on the edge of a square may have either color.
  assert (error < 6).mean() > 0.99
  for geom in range(-1, 4):
    assert (ids == geom).sum() > 30
  assert 0.2 < is_odd[ids == 0].mean() < 0.8 and np.ptp(noise[ids == 3]) > 0.3
  assert 0.2 < is_odd[ids == -1].mean() < 0.8
