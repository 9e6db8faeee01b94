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
  """Returns OpenCV; see ``vendor``."""
  return vendor("cv2", "opencv-contrib-python-headless")
