"""Packages of the vendors, which only the robot needs."""

from __future__ import annotations

import importlib
from typing import Any

from apnpql_jax.errors import DeviceError


def vendor(module: str, package: str) -> Any:
  """Imports a module of a vendor's package.

  Raises:
    DeviceError: The package is missing, or a library that it needs.
  """
  try:
    return importlib.import_module(module)
  except ImportError as error:
    lacks = "" if error.name in (module, module.split(".")[0]) else f" ({error})"
    raise DeviceError(
      f"robot needs {package}{lacks}: pip install 'apnpql-jax[robot]'"
    ) from error


def opencv() -> Any:
  """Returns OpenCV; see ``vendor``. It must have the module of the boards."""
  cv2 = vendor("cv2", package := "opencv-contrib-python-headless")
  if not hasattr(cv2, "aruco"):
    raise DeviceError(
      f"robot needs {package}>=4.11, and the installed OpenCV {cv2.__version__} lacks "
      "cv2.aruco: pip install 'apnpql-jax[robot]'"
    )
  return cv2
