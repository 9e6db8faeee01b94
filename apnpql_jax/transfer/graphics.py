"""Off-screen graphics and the resizing of images."""

from __future__ import annotations

import importlib
import os
from typing import Any

import numpy as np

from apnpql_jax.errors import ConfigError, one_line


def area_resized(image: np.ndarray, factor: int) -> np.ndarray:
  """Returns the means of blocks of factor x factor pixels, u8[H, W, 3]."""
  height, width = image.shape[0] // factor, image.shape[1] // factor
  blocks = image.reshape(height, factor, width, factor, 3).astype(np.float32)
  return (blocks.mean((1, 3)) + 0.5).astype(np.uint8)


def off_screen(width: int, height: int) -> Any:
  """Returns a current OpenGL context without a window.

  Raises:
    ConfigError: No graphics library can be loaded.
  """
  chosen = os.environ.get("MUJOCO_GL", "")
  reasons = []
  for library in [chosen] if chosen in ("egl", "osmesa") else ["egl", "osmesa"]:
    try:
      context = importlib.import_module(f"mujoco.{library}").GLContext(width, height)
      context.make_current()
      return context
    except Exception as error:  # Whatever a missing library causes.
      reasons.append(f"{library}: {one_line(error)}")
  raise ConfigError(
    "--renderer opengl needs EGL or OSMesa (Debian: libegl1 with libegl-mesa0, or "
    f"libosmesa6); {'; '.join(reasons)}"
  )
