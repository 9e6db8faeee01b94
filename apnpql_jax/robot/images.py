"""The geometry of images: from those of a real camera to those of the policy.

An image is undistorted, cropped around the optical axis to the field of view of the
training, and resized by area. Lenses are plain values: height and width of the image,
fx, fy, cx, cy in pixels with the center of the first pixel at 0, and the distortion k1,
k2, p1, p2, k3 of OpenCV.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

import numpy as np

from apnpql_jax.errors import DeviceError
from apnpql_jax.robot.vendors import opencv

Json = dict[str, Any]

MISSING = 0.02
"""Share of an image that may lie beyond the sensor; the nearest pixels fill it.

The wrist camera of the training sees what a D435 sees. The optical axis of a real one
is some pixels off the center of its sensor.
"""

_MODELS = "brown_conrady", "inverse_brown_conrady", "modified_brown_conrady"


def opencv_lens(lens: Json, model: str, coefficients: Sequence[float]) -> Json:
  """Returns a lens with the maker's distortion.

  Three models of librealsense are OpenCV's except for terms of higher order, which move
  a pixel of a D455 by less than 0.01 px. (librealsense 2.59 also projects "inverse"
  ones from ideal to real pixels.)

  Args:
    lens: The lens without its distortion.
    model: Name of the distortion model in librealsense.
    coefficients: Its five coefficients.

  Raises:
    DeviceError: The model is another one.
  """
  known = [float(x) for x in coefficients]
  if any(known) and model not in _MODELS:
    raise DeviceError(f"the distortion model {model} is not supported")
  return {**lens, "distortion": known}


class Preparation:
  """Conversion of a camera's images to those of a view of the contract."""

  def __init__(self, lens: Json, view: Json):
    """Computes which pixels belong together.

    Args:
      lens: The lens of the real camera.
      view: An entry of ``cameras`` of the contract.

    Raises:
      DeviceError: The camera sees less than the view, or OpenCV is missing.
    """
    self._cv2 = opencv()
    self._size = view["height"], view["width"]
    inner = view["intrinsics_px"]
    # As many samples per pixel of the view as the camera has pixels there.
    factor = max(1, math.ceil(max(lens["fx"], lens["fy"]) / inner["fy"]))
    rows, columns = (
      (np.arange(factor * count) + 0.5) / factor - 0.5 for count in self._size
    )
    x, y = np.meshgrid(
      (columns - inner["cx"]) / inner["fx"], (rows - inner["cy"]) / inner["fy"]
    )
    rays = np.stack([x, y])
    x, y = _distorted(rays, *lens["distortion"])
    self._x = (lens["fx"] * x + lens["cx"]).astype(np.float32)
    self._y = (lens["fy"] * y + lens["cy"]).astype(np.float32)
    self._native = lens["height"], lens["width"]
    beyond = abs(self._x - (lens["width"] - 1) / 2) > lens["width"] / 2
    beyond |= abs(self._y - (lens["height"] - 1) / 2) > lens["height"] / 2
    if beyond.mean() > MISSING:
      sees, needs = (_angles(x) for x in (lens, {**inner, **view}))
      raise DeviceError(
        f"the camera sees {sees}, but the policy needs {needs} around the optical axis "
        f"({beyond.mean():.0%} would be missing): use another mode or camera"
      )

  def __call__(self, image: np.ndarray) -> np.ndarray:
    """Returns the image of the view, u8[height, width, 3].

    Raises:
      DeviceError: The image has another size than the lens.
    """
    if image.shape[:2] != self._native:
      sizes = "x".join(map(str, image.shape[:2])), "x".join(map(str, self._native))
      raise DeviceError(f"the image has {sizes[0]} pixels, but its lens {sizes[1]}")
    cv2 = self._cv2
    ideal = cv2.remap(
      image, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    height, width = self._size
    return cv2.resize(ideal, (width, height), interpolation=cv2.INTER_AREA)


def _distorted(
  rays: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float
) -> np.ndarray:
  """Returns where a lens with distortion sees the directions (x, y, 1), f64[2, ...]."""
  x, y = rays
  r2 = x * x + y * y
  shifts = [
    2 * p1 * x * y + p2 * (r2 + 2 * x * x),
    2 * p2 * x * y + p1 * (r2 + 2 * y * y),
  ]
  return rays * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) + shifts


def _angles(lens: Json) -> str:
  """Returns the fields of view, horizontal and vertical."""
  angles = (
    2 * math.degrees(math.atan(lens[size] / (2 * lens[focal])))
    for size, focal in (("width", "fx"), ("height", "fy"))
  )
  return " x ".join(f"{angle:.1f}" for angle in angles) + " degrees"
