"""The ray caster against MuJoCo's rays, MuJoCo's rasterizer and NumPy."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import render_oracles

from apnpql_jax.render import CameraSpec, Geoms, Lighting, render

MJCF = Path(__file__).resolve().parents[2] / "mjcf"
HEIGHT, WIDTH = 54, 72
ORACLES = render_oracles.available()
if "rasteriser" not in ORACLES:
  warnings.warn("no graphics library: compared with MuJoCo's rays only", stacklevel=1)

_GEOMS = {
  "sphere": 'type="sphere" size="0.09"',
  "ball": 'type="sphere" size="0.03"',
  "capsule": 'type="capsule" size="0.05 0.12"',
  "rod": 'type="capsule" size="0.02 0.2"',
  "egg": 'type="ellipsoid" size="0.05 0.08 0.12"',
  "lens": 'type="ellipsoid" size="0.12 0.1 0.015"',
  "box": 'type="box" size="0.08 0.12 0.05"',
  "slab": 'type="box" size="0.15 0.1 0.008"',
  "cylinder": 'type="cylinder" size="0.09 0.06"',
  "disc": 'type="cylinder" size="0.12 0.01"',
}


def _scene() -> str:
  bodies = "".join(
    f'<body name="{name}" mocap="true"><geom name="{name}" {shape} '
    f'rgba="{0.9 - 0.08 * k:.2f} {0.2 + 0.08 * k:.2f} 0.5 1"/></body>'
    for k, (name, shape) in enumerate(_GEOMS.items())
  )
  return f"""
<mujoco>
  <statistic extent="2" center="0 0 0.3"/>
  <visual><map znear="0.01" zfar="10"/></visual>
  <worldbody>
    <light directional="true" dir="0.4 -0.2 -1"/>
    <geom name="floor" type="plane" size="1.5 1.2 0.1" rgba="0.8 0.8 0.7 1"/>
    <geom name="hidden" type="box" size="0.3 0.3 0.3" rgba="1 0 0 0"/>
    <geom name="helper" type="box" size="0.3 0.3 0.3" pos="0.3 0 0" group="3"/>
    {bodies}
    <body name="eye" mocap="true"><camera name="eye" fovy="50"/></body>
  </worldbody>
</mujoco>"""


def _look_at(position: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
  """Returns the quaternion of a camera at ``position`` that looks at ``target``."""
  back = (position - target) / np.linalg.norm(position - target)
  right = np.cross([0.3, 0.2, 0.93], back)
  right /= np.linalg.norm(right)
  matrix = np.stack([right, np.cross(back, right), back], axis=1)
  turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
  matrix[:, :2] = matrix[:, :2] @ turn
  quaternion = np.zeros(4)
  mujoco.mju_mat2Quat(quaternion, matrix.reshape(-1))
  return quaternion


def _randomize(model: mujoco.MjModel, data: mujoco.MjData, rng) -> None:
  """Draws geoms in a box around (0, 0, 0.45), and the camera 1.1 to 1.6 m away."""
  for k in range(model.nmocap):
    data.mocap_pos[k] = rng.uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 0.7])
    data.mocap_quat[k] = rng.normal(size=4)
    data.mocap_quat[k] /= np.linalg.norm(data.mocap_quat[k])
  center = np.array([0.0, 0.0, 0.45])
  direction = rng.normal(size=3)
  direction[2] = 0.2 + abs(direction[2])
  direction /= np.linalg.norm(direction)
  eye = model.body("eye").mocapid[0]
  data.mocap_pos[eye] = center + rng.uniform(1.1, 1.6) * direction
  target = center + rng.normal(size=3) * 0.1
  data.mocap_quat[eye] = _look_at(data.mocap_pos[eye], target, rng.uniform(-3, 3))
  mujoco.mj_forward(model, data)


def _poses(data: mujoco.MjData, camera: CameraSpec) -> tuple[np.ndarray, ...]:
  """Returns copies of the poses that ``render`` takes, in float32."""
  arrays = (
    data.geom_xpos,
    data.geom_xmat.reshape(-1, 3, 3),
    data.cam_xpos[camera.id],
    data.cam_xmat[camera.id].reshape(3, 3),
  )
  return tuple(np.array(a, np.float32) for a in arrays)


@dataclasses.dataclass(frozen=True)
class World:
  """A model, its visible geoms, and n random states with their poses."""

  model: mujoco.MjModel
  geoms: Geoms
  camera: CameraSpec
  states: np.ndarray
  poses: tuple[np.ndarray, ...]  # [n, ...]

  def data(self, k: int) -> mujoco.MjData:
    """Returns MuJoCo's data in state ``k``."""
    data = mujoco.MjData(self.model)
    mujoco.mj_setState(self.model, data, self.states[k], render_oracles.STATE)
    mujoco.mj_forward(self.model, data)
    return data


@pytest.fixture(scope="module")
def world() -> World:
  """Returns a world with every geom type in random poses."""
  model = mujoco.MjModel.from_xml_string(_scene())
  data = mujoco.MjData(model)
  camera = CameraSpec.from_model(model, "eye", height=HEIGHT, width=WIDTH)
  rng, states, poses = np.random.default_rng(0), [], []
  for _ in range(16):
    _randomize(model, data, rng)
    states.append(render_oracles.get_state(model, data))
    poses.append(_poses(data, camera))
  stacked = tuple(np.stack(p) for p in zip(*poses, strict=True))
  return World(model, Geoms.from_model(model), camera, np.stack(states), stacked)


def _interior(ids: np.ndarray) -> np.ndarray:
  """Returns bool[n, H, W]: all eight neighbors of the pixel show the same geom."""
  padded = np.pad(ids, ((0, 0), (1, 1), (1, 1)), "edge")
  height, width = ids.shape[1:]
  same = np.ones(ids.shape, bool)
  for row in range(3):
    for column in range(3):
      same &= padded[:, row : row + height, column : column + width] == ids
  return same


def _assert_agree(image, ids: np.ndarray, depth: np.ndarray, tolerance: float):
  """Asserts that all pixels agree except those at edges."""
  interior = _interior(ids)
  agree = (np.asarray(image.segmentation) == ids)[interior]
  assert agree.mean() >= 0.999
  hit = interior & (np.asarray(image.segmentation) == ids) & (ids >= 0)
  error = np.abs(np.asarray(image.depth)[hit] / depth[hit] - 1.0)
  assert np.quantile(error, 0.999) < tolerance
  nothing = np.asarray(image.segmentation) == -1
  np.testing.assert_array_equal(np.isinf(np.asarray(image.depth)), nothing)


@pytest.mark.parametrize("oracle", ORACLES)
def test_segmentation_and_depth_of_random_states(world, oracle):
  """Every geom type is visible and agrees with the oracle."""
  image = render(world.geoms, world.camera, *world.poses)
  ids, depth = render_oracles.look(
    oracle, world.model, world.states, "eye", HEIGHT, WIDTH
  )
  assert set(np.unique(ids)) == {-1, *world.geoms.ids.tolist()}
  _assert_agree(image, ids, depth, 1e-3 if oracle == "rasteriser" else 1e-4)


@pytest.mark.parametrize("oracle", ORACLES)
@pytest.mark.parametrize(
  ("name", "height", "width"), [("global", 72, 96), ("wrist", 36, 64)]
)
def test_segmentation_and_depth_of_push_plate(oracle, name, height, width):
  """Both cameras of a shipped scene agree with the oracle."""
  model = mujoco.MjModel.from_xml_path(str(MJCF / "push_plate.xml"))
  data, rng = mujoco.MjData(model), np.random.default_rng(0)
  camera = CameraSpec.from_model(model, name, height=height, width=width)
  states, poses = [], []
  for _ in range(8):
    mujoco.mj_resetData(model, data)
    data.qpos[:6] = [0.0, -1.2, 1.9, -2.2, -1.57, 0.0] + rng.normal(size=6) * 0.3
    data.qpos[6:10] = rng.uniform(0.0, 1.1)
    plate = model.joint("plate").qposadr[0]
    data.qpos[plate : plate + 2] = rng.uniform([0.35, -0.3], [0.7, 0.3])
    data.mocap_pos[0, :2] = rng.uniform([0.35, -0.3], [0.7, 0.3])
    mujoco.mj_forward(model, data)
    states.append(render_oracles.get_state(model, data))
    poses.append(_poses(data, camera))
  batch = [np.stack(p) for p in zip(*poses, strict=True)]
  image = render(Geoms.from_model(model), camera, *batch)
  ids, depth = render_oracles.look(oracle, model, np.stack(states), name, height, width)
  _assert_agree(image, ids, depth, 1e-3)


def _single(xml: str, height: int = HEIGHT, width: int = WIDTH):
  """Returns model, data and camera "eye" of a scene at rest."""
  model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  return model, data, CameraSpec.from_model(model, "eye", height=height, width=width)


def test_rays_along_the_axis_of_round_geoms():
  """In the middle pixel the transverse part of the direction vanishes."""
  model, data, camera = _single(
    """<worldbody>
      <geom type="plane" size="0 0 0.1"/>
      <geom type="cylinder" size="0.1 0.05" pos="0 0 0.05"/>
      <geom type="capsule" size="0.03 0.1" pos="0.3 0 0.2"/>
      <geom type="box" size="0.05 0.05 0.05" pos="-0.3 0 0.1"/>
      <camera name="eye" pos="0 0 1" fovy="60"/></worldbody>""",
    height=41,
    width=41,
  )
  for x in (0.0, 0.3, -0.3):
    data.cam_xpos[0, 0] = x
    ids, depth, _ = render_oracles.cast_rays(model, data, "eye", 41, 41)
    poses = _poses(data, camera)
    image = render(Geoms.from_model(model), camera, *poses)
    _assert_agree(jax.tree.map(lambda a: a[None], image), ids[None], depth[None], 1e-4)
    assert image.segmentation[20, 20] == ids[20, 20] > 0
    np.testing.assert_allclose(image.depth[20, 20], depth[20, 20], rtol=1e-5)


def test_unbounded_plane_ends_at_the_horizon():
  """Rays above the horizon hit nothing."""
  model, data, camera = _single(
    """<worldbody><geom type="plane" size="0 0 0.1"/>
    <camera name="eye" pos="0 0 0.5" xyaxes="0 -1 0 0.1 0 1" fovy="60"/></worldbody>"""
  )
  image = render(Geoms.from_model(model), camera, *_poses(data, camera))
  ids, depth, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  assert {-1, 0} == set(np.unique(ids))
  np.testing.assert_array_equal(image.segmentation, ids)
  near = depth < 20.0
  np.testing.assert_allclose(np.asarray(image.depth)[near], depth[near], rtol=1e-4)


def test_a_plane_is_invisible_from_behind():
  """A camera under the plane sees the sphere above it."""
  model, data, camera = _single(
    """<worldbody><geom type="plane" size="0 0 0.1"/>
    <geom type="sphere" size="0.1" pos="0 0 0.5"/>
    <camera name="eye" pos="0 0 -1" euler="180 0 0"/></worldbody>"""
  )
  image = render(Geoms.from_model(model), camera, *_poses(data, camera))
  ids, _, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  assert set(np.unique(image.segmentation)) == {-1, 1}
  np.testing.assert_array_equal(image.segmentation, ids)


@pytest.mark.parametrize("name", sorted(_GEOMS))
def test_a_camera_inside_a_geom_sees_through_it(world, name):
  """The image equals that with the geom moved behind the camera."""
  poses = [p[0].copy() for p in world.poses]
  geom = world.model.geom(name).id
  poses[0][geom], poses[1][geom] = poses[2], poses[3] @ poses[1][geom]
  inside = render(world.geoms, world.camera, *poses)
  poses[0][geom] = poses[2] + 5.0 * poses[3][:, 2]
  behind = render(world.geoms, world.camera, *poses)
  assert not np.any(np.asarray(inside.segmentation) == geom)
  jax.tree.map(np.testing.assert_array_equal, inside, behind)


def test_geoms_nearer_than_the_limit_are_not_drawn(world):
  """Geoms beyond the limit stay as they are."""
  poses = [p[0] for p in world.poses]
  everything = render(world.geoms, world.camera, *poses)
  limit = float(np.median(everything.depth))
  beyond = render(world.geoms, world.camera, *poses, near=limit)
  assert np.asarray(beyond.depth).min() > limit
  far = np.asarray(everything.depth) > limit
  assert 0.2 < far.mean() < 0.8
  kept = np.asarray(beyond.segmentation) == np.asarray(everything.segmentation)
  assert kept[far].all()


def test_shading_follows_the_documented_formula(world):
  """The formula in NumPy, with the normals of MuJoCo's rays, gives the same colors."""
  light = Lighting(
    direction=(0.4, -0.2, -1.0),
    ambient=0.2,
    diffuse=0.7,
    fill=0.4,
    background=(0.1, 0.2, 0.3),
  )
  image = render(world.geoms, world.camera, *world.poses, light)
  toward = -np.array(light.direction) / np.linalg.norm(light.direction)
  for k in range(len(world.states)):
    data = world.data(k)
    ids, _, normal = render_oracles.cast_rays(world.model, data, "eye", HEIGHT, WIDTH)
    cosine = normal @ toward
    lit = np.where(cosine > 0, cosine, -light.fill * cosine)
    intensity = light.ambient + light.diffuse * lit
    expected = intensity[..., None] * world.model.geom_rgba[ids, :3]
    expected[ids < 0] = light.background
    close = np.abs(np.asarray(image.rgb[k]) / 255.0 - expected).max(axis=-1) < 0.02
    same = np.asarray(image.segmentation[k]) == ids
    # Not all: faces of a box or cylinder meet in the interior of a segment.
    assert close[same].mean() > 0.99


def test_intensity_one_is_full_white():
  """Full intensity gives 255 and neither overflows nor changes the color."""
  model, data, camera = _single(
    """<worldbody><geom type="plane" size="0 0 0.1" rgba="1 0.5 0 1"/>
    <camera name="eye" pos="0 0 1"/></worldbody>"""
  )
  light = Lighting(direction=(0.0, 0.0, -1.0), ambient=0.3, diffuse=0.7)
  image = render(Geoms.from_model(model), camera, *_poses(data, camera), light)
  assert set(np.unique(np.asarray(image.rgb)[..., 0])) == {255}
  assert set(np.unique(np.asarray(image.rgb)[..., 1])) == {127}
  assert set(np.unique(np.asarray(image.rgb)[..., 2])) == {0}


def _shadow_rays(world: World, data, casters: list[int], toward) -> np.ndarray:
  """Returns bool[H, W]: the ray from the visible point to the light meets a caster."""
  model, camera = world.model, world.camera.id
  rays = render_oracles.ray_directions(HEIGHT, WIDTH, model.cam_fovy[camera])
  _, depth, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  rotation = data.cam_xmat[camera].reshape(3, 3)
  steps = (depth / -rays[..., 2])[..., None] * (rays @ rotation.T)
  points = data.cam_xpos[camera] + np.nan_to_num(steps, posinf=0.0)
  dark = np.zeros((HEIGHT, WIDTH), bool)
  groups = np.array([0, 0, 0, 0, 0, 1], np.uint8)
  before = model.geom_group.copy()
  model.geom_group[casters] = 5
  for index in np.ndindex(dark.shape):
    dark[index] = (
      mujoco.mj_ray(model, data, points[index], toward, groups, True, -1, None) >= 0
    )
  model.geom_group[:] = before
  return dark


def test_shadows_fall_where_rays_to_the_light_are_blocked(world):
  """Shadows dim the floor, and only where MuJoCo's rays meet a caster."""
  casters = tuple(world.model.geom(n).id for n in ("sphere", "rod", "capsule", "slab"))
  floor = world.model.geom("floor").id
  plain = Lighting(direction=(0.4, -0.2, -1.0))
  shaded = dataclasses.replace(
    plain, shadow_casters=casters, shadow_receivers=(floor,), shadow=0.5
  )
  toward = -np.array(plain.direction) / np.linalg.norm(plain.direction)
  states = slice(0, 4)
  poses = [p[states] for p in world.poses]
  lit = render(world.geoms, world.camera, *poses, plain)
  image = render(world.geoms, world.camera, *poses, shaded, outputs=("rgb",))
  on_floor = np.asarray(lit.segmentation) == floor
  before, after = np.asarray(lit.rgb, np.int32), np.asarray(image.rgb, np.int32)
  changed = (before != after).any(axis=-1)
  assert not changed[~on_floor].any()
  np.testing.assert_allclose(after[changed], before[changed] * 0.5, atol=1.5)
  expected = np.stack(
    [_shadow_rays(world, world.data(k), list(casters), toward) for k in range(4)]
  )
  expected &= on_floor
  assert expected.mean() > 0.01
  # Rays decide both images, so edges count too.
  assert (changed != expected)[on_floor].sum() <= 2


@pytest.mark.parametrize("repeat", [2, 5])
def test_checker_follows_the_texture(repeat):
  """Squares have the edge and colors of the MJCF texture."""
  model, data, camera = _single(
    f"""<asset><texture name="t" type="2d" builtin="checker" rgb1="0.2 0.4 0.6"
      rgb2="0.8 0.6 0.4" width="32" height="32"/>
      <material name="m" texture="t" texrepeat="{repeat} {repeat}" texuniform="true"/>
      </asset><worldbody><geom type="plane" size="0 0 0.1" material="m" euler="0 0 30"/>
      <camera name="eye" pos="0.3 0.1 1" euler="10 5 0" fovy="60"/></worldbody>"""
  )
  light = Lighting(ambient=1.0, diffuse=0.0)
  image = render(Geoms.from_model(model), camera, *_poses(data, camera), light)
  rays = render_oracles.ray_directions(HEIGHT, WIDTH, 60.0)
  _, depth, _ = render_oracles.cast_rays(model, data, "eye", HEIGHT, WIDTH)
  points = (depth / -rays[..., 2])[..., None] * (
    rays @ data.cam_xmat[0].reshape(3, 3).T
  )
  local = (points + data.cam_xpos[0]) @ data.geom_xmat[0].reshape(3, 3)
  odd = np.floor(local[..., :2] * repeat).sum(axis=-1) % 2 == 1
  expected = np.where(odd[..., None], [0.2, 0.4, 0.6], [0.8, 0.6, 0.4])
  close = np.abs(np.asarray(image.rgb) / 255.0 - expected).max(axis=-1) < 0.01
  assert close.mean() > 0.995
  assert 0.3 < odd.mean() < 0.7


def test_same_pixels_alone_batched_and_inside_transformations(world):
  """Batches, vmap, scan and single images differ by rounding at most."""

  def view(*poses):
    return render(world.geoms, world.camera, *poses)

  batched = view(*world.poses)
  mapped = jax.jit(jax.vmap(view))(*world.poses)
  _, scanned = jax.lax.scan(lambda _, poses: (None, view(*poses)), None, world.poses)
  folded = view(*(p.reshape(2, 8, *p.shape[1:]) for p in world.poses))
  alone = [view(*(p[k] for p in world.poses)) for k in range(len(world.states))]
  others = (
    mapped,
    scanned,
    jax.tree.map(lambda x: x.reshape(16, *x.shape[2:]), folded),
    jax.tree.map(lambda *x: jnp.stack(x), *alone),
    view(*world.poses),
  )
  capsules = world.model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
  grazed = np.isin(batched.segmentation, np.flatnonzero(capsules))
  for other in others:
    np.testing.assert_array_equal(other.segmentation, batched.segmentation)
    depths = np.asarray(other.depth), np.asarray(batched.depth)
    np.testing.assert_allclose(*(x[~grazed] for x in depths), rtol=1e-5)
    # Rays that graze a capsule amplify rounding: 3e-5 on 10 pixels of 60,000.
    np.testing.assert_allclose(*(x[grazed] for x in depths), rtol=5e-5)
    difference = np.abs(
      np.asarray(other.rgb, np.int32) - np.asarray(batched.rgb, np.int32)
    )
    assert difference.max() <= 1
  np.testing.assert_array_equal(others[-1].rgb, batched.rgb)


def test_shapes_dtypes_and_omitted_outputs(world):
  """Leading axes are kept, and outputs not requested are None."""
  poses = [p[:6].reshape(2, 3, *p.shape[1:]) for p in world.poses]
  image = render(world.geoms, world.camera, *poses, outputs=("rgb",))
  assert image.rgb.shape == (2, 3, HEIGHT, WIDTH, 3) and image.rgb.dtype == jnp.uint8
  assert image.depth is None and image.segmentation is None
  image = render(world.geoms, world.camera, *poses, outputs=("depth", "segmentation"))
  assert image.rgb is None
  assert image.depth.shape == image.segmentation.shape == (2, 3, HEIGHT, WIDTH)
  assert image.depth.dtype == jnp.float32
  assert image.segmentation.dtype == jnp.int32


def test_pixels_need_not_fill_the_blocks(world):
  """63 pixels are not a multiple of the number of blocks."""
  odd = dataclasses.replace(world.camera, height=7, width=9)
  image = render(world.geoms, odd, *world.poses)
  ids, depth = render_oracles.look("rays", world.model, world.states, "eye", 7, 9)
  agree = np.asarray(image.segmentation) == ids
  assert agree.mean() > 0.99
  np.testing.assert_allclose(np.asarray(image.depth)[agree], depth[agree], rtol=1e-3)


def test_no_silent_promotion(world):
  """Shadows and shading pass JAX's strict promotion."""
  with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
    light = Lighting(
      shadow_casters=(world.model.geom("box").id,),
      shadow_receivers=(world.model.geom("floor").id,),
    )
    image = render(world.geoms, world.camera, *world.poses, light)
  assert np.isfinite(np.asarray(image.rgb)).all()


def test_invalid_arguments_are_rejected(world):
  """The errors name the argument and the valid choices."""
  poses = world.poses
  with pytest.raises(ValueError, match="outputs must be some of"):
    render(world.geoms, world.camera, *poses, outputs=("color",))
  with pytest.raises(ValueError, match="poses do not match"):
    render(world.geoms, world.camera, poses[0][:3], *poses[1:])
  floor, disc = world.model.geom("floor").id, world.model.geom("disc").id
  light = Lighting(shadow_casters=(disc,), shadow_receivers=(floor,))
  with pytest.raises(ValueError, match=rf"geoms \[{disc}\] cannot take part"):
    render(world.geoms, world.camera, *poses, light)
  with pytest.raises(ValueError, match="must lie in"):
    Lighting(ambient=0.8, diffuse=0.8)
  with pytest.raises(ValueError, match="both cast and receive"):
    Lighting(shadow_casters=(3,), shadow_receivers=(3,))
  with pytest.raises(ValueError, match="no camera 'nose'.*'eye'"):
    CameraSpec.from_model(world.model, "nose", height=8, width=8)
  with pytest.raises(ValueError, match="empty"):
    CameraSpec.from_model(world.model, "eye", height=0, width=8)


def test_unsupported_geoms_are_rejected():
  """The error names the geom and the reason."""
  model = mujoco.MjModel.from_xml_string(
    """<mujoco><asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 1"/></asset>
    <worldbody><geom name="hill" type="hfield" hfield="h"/></worldbody></mujoco>"""
  )
  with pytest.raises(ValueError, match="'hill': .* hfield .*mesh.*group.*--obs state"):
    Geoms.from_model(model)


def test_hidden_geoms_and_materials():
  """Alpha and group hide geoms; a material replaces only the default color."""
  model = mujoco.MjModel.from_xml_string(
    """<mujoco><asset><material name="m" rgba="0.1 0.2 0.3 1"/></asset><worldbody>
    <geom type="sphere" size="1" rgba="1 0 0 0"/>
    <geom type="sphere" size="1" group="4"/>
    <geom type="sphere" size="1" material="m"/>
    <geom type="plane" size="1 1 1" material="m" rgba="0.9 0.8 0.7 1"/>
    </worldbody></mujoco>"""
  )
  geoms = Geoms.from_model(model)
  assert geoms.ids.tolist() == [3, 2]
  np.testing.assert_allclose(geoms.colors, [[0.9, 0.8, 0.7], [0.1, 0.2, 0.3]])
  assert Geoms.from_model(model, groups=(4,)).ids.tolist() == [1]


def test_light_of_the_model(world):
  """The direction comes from the MJCF, which must have one directional light."""
  light = Lighting.from_model(world.model, ambient=0.1)
  direction = np.array([0.4, -0.2, -1.0])
  np.testing.assert_allclose(light.direction, direction / np.linalg.norm(direction))
  assert light.ambient == 0.1
  dark = mujoco.MjModel.from_xml_string("<mujoco/>")
  with pytest.raises(ValueError, match="exactly one directional light"):
    Lighting.from_model(dark)
