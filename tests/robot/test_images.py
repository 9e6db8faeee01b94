"""From images of real cameras to those of the policy, against other renderings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import interpolate

from apnpql_jax.errors import DeviceError
from apnpql_jax.render import Lighting
from apnpql_jax.robot import images
from apnpql_jax.robot.doubles import renderer
from apnpql_jax.robot.doubles.plant import compile_scene

pytest.importorskip("cv2", reason="needs OpenCV")

COEFFICIENTS = (-0.0565, 0.0679, 0.0005, -0.0003, -0.0218)
"""About those of the color sensor of a D455."""


def view(height: int, width: int, fovy: float) -> images.Json:
  focal = 0.5 * height / math.tan(math.radians(fovy) / 2)
  center = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
  return {
    "height": height,
    "width": width,
    "vertical_fov_deg": fovy,
    "intrinsics_px": {"fx": focal, "fy": focal, **center},
  }


def lens(height: int, width: int, focal: float, **changes) -> images.Json:
  center = {"cx": 0.5 * (width - 1), "cy": 0.5 * (height - 1)}
  plain = {"height": height, "width": width, "fx": focal, "fy": focal, **center}
  return {**plain, "distortion": [0.0] * 5, **changes}


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
  """Returns smooth colors of the directions (x, y, 1), u8[..., 3]."""
  waves = [np.sin(9 * x + 4 * y), np.cos(7 * y - 3 * x), np.sin(11 * x * y + 5 * x)]
  return np.round(127.5 + 120 * np.stack(waves, -1)).astype(np.uint8)


def pixels(lens: images.Json) -> tuple[np.ndarray, np.ndarray]:
  """Returns the columns and rows of a sensor's pixels, f64[H, W]."""
  return np.meshgrid(np.arange(lens["width"]), np.arange(lens["height"]))


@pytest.fixture(scope="module")
def state() -> dict:
  """Returns the keyframe "neutral" of push_plate."""
  model = compile_scene("push_plate")
  return {
    "qpos": model.key("neutral").qpos,
    "mocap_pos": model.key("neutral").mpos,
    "mocap_quat": model.key("neutral").mquat,
  }


def drawn(state: dict, fovy: float, size: list[int]) -> np.ndarray:
  """Returns the global camera's image with a field of view, u8[H, W, 3]."""
  painter = renderer.Renderer("push_plate", {"global": fovy}, size)
  with painter.view:
    return painter.draw(state)[0]


def test_a_wide_image_becomes_the_rendering_with_the_narrow_field_of_view(state):
  inner = view(72, 96, 36.0)
  wide = drawn(state, 59.0, [480, 848])
  focal = 240 / math.tan(math.radians(29.5))
  found = images.Preparation(lens(480, 848, focal), inner)(wide)
  narrow = drawn(state, 36.0, [72 * 8, 96 * 8])
  expected = narrow.reshape(72, 8, 96, 8, 3).mean((1, 3))
  assert found.shape == (72, 96, 3) and found.dtype == np.uint8
  assert np.abs(found - expected).mean() < 0.5
  # An image that is shifted by a pixel differs by much more.
  assert np.abs(found[:, 1:] - expected[:, :-1]).mean() > 1.5
  assert np.abs(found[1:] - expected[:-1]).mean() > 1.5


def test_the_optical_axis_is_the_center_wherever_the_sensor_has_it():
  inner = view(60, 80, 40.0)
  x, y = (
    (k - inner["intrinsics_px"][c]) / inner["intrinsics_px"]["fx"]
    for k, c in zip(pixels(inner), ("cx", "cy"), strict=True)
  )
  expected = pattern(x, y)
  for cx, cy in ((319.5, 239.5), (300.0, 251.0), (333.3, 228.8)):
    real = lens(480, 640, 400.0, cx=cx, cy=cy)
    column, row = pixels(real)
    image = pattern((column - cx) / 400.0, (row - cy) / 400.0)
    found = images.Preparation(real, inner)(image)
    assert np.abs(found.astype(int) - expected).max() <= 3


@pytest.mark.parametrize(
  "model", ["inverse_brown_conrady", "brown_conrady", "modified_brown_conrady"]
)
def test_distortion_is_that_of_librealsense(model):
  rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2")
  inner = view(60, 80, 44.0)
  plain = {k: x for k, x in lens(480, 640, 390.0).items() if k != "distortion"}
  plain["cx"], plain["cy"] = 322.1, 236.4
  real = images.opencv_lens(plain, model, COEFFICIENTS)
  intrinsics = rs.intrinsics()
  intrinsics.height, intrinsics.width = 480, 640
  intrinsics.fx = intrinsics.fy = 390.0
  intrinsics.ppx, intrinsics.ppy = plain["cx"], plain["cy"]
  intrinsics.model, intrinsics.coeffs = getattr(rs.distortion, model), COEFFICIENTS
  # The ray of each pixel by inverting the library's own projection on a grid.
  grid = np.stack(np.meshgrid(np.linspace(-1.1, 1.1, 221), np.linspace(-0.9, 0.9, 181)))
  hits = np.array(
    [
      rs.rs2_project_point_to_pixel(intrinsics, [float(x), float(y), 1.0])
      for x, y in grid.reshape(2, -1).T
    ]
  )
  straight = grid.reshape(2, -1).T * 390.0 + [plain["cx"], plain["cy"]]
  seen = (abs(hits - [320, 240]) < [320, 240]).all(1)
  assert np.abs(hits - straight)[seen].max() > 3  # px
  inverse = interpolate.CloughTocher2DInterpolator(hits, grid.reshape(2, -1).T)
  rays = inverse(np.stack(pixels(plain), -1).reshape(-1, 2)).reshape(480, 640, 2)
  found = images.Preparation(real, inner)(pattern(rays[..., 0], rays[..., 1]))
  x, y = (
    (k - inner["intrinsics_px"][c]) / inner["intrinsics_px"]["fx"]
    for k, c in zip(pixels(inner), ("cx", "cy"), strict=True)
  )
  error = np.abs(found.astype(int) - pattern(x, y))
  assert error.max() <= 5 and error.mean() < 1


def test_a_camera_that_sees_less_than_the_policy_needs_is_refused():
  with pytest.raises(DeviceError, match=r"sees 55\.1 x 42\.7 .* needs 69\.3 x 42\.5"):
    images.Preparation(lens(480, 640, 614.0), view(36, 64, 42.5))
  images.Preparation(lens(480, 848, 609.0), view(36, 64, 42.5))  # Sees a bit more.


def test_a_narrow_border_that_is_missing_is_filled():
  real = lens(480, 848, 609.0, cx=431.0, cy=243.0)
  image = np.full((480, 848, 3), 77, np.uint8)
  assert (images.Preparation(real, view(36, 64, 42.5))(image) == 77).all()


def test_an_unknown_distortion_or_size_is_refused():
  plain = {k: x for k, x in lens(480, 640, 390.0).items() if k != "distortion"}
  with pytest.raises(DeviceError, match="kannala_brandt4 is not supported"):
    images.opencv_lens(plain, "kannala_brandt4", COEFFICIENTS)
  prepare = images.Preparation(lens(480, 640, 390.0), view(60, 80, 44.0))
  with pytest.raises(DeviceError, match="240x320 pixels, but its lens 480x640"):
    prepare(np.zeros((240, 320, 3), np.uint8))


def test_the_double_has_the_light_of_the_training():
  light = Lighting()
  assert (renderer.AMBIENT, renderer.DIFFUSE) == (light.ambient, light.diffuse)
