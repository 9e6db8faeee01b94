"""What the renderers share: cameras, light and colors."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from apnpql_jax.render import Lighting

CAMERAS = ("global", "wrist")
OVERSAMPLING = 2
"""Pixels that are rendered per pixel of an image, along each axis."""


class Light(NamedTuple):
  """The light of a world without an unseen look."""

  direction: np.ndarray  # f64[3], of travel
  ambient: float
  diffuse: float
  background: Any  # color


def light_of(model: mujoco.MjModel, fields: dict[str, np.ndarray]) -> Light:
  """Returns the light of one world from its ``PhysicsState.fields``."""
  sun, plain = Lighting.from_model(model).id, Lighting()
  direction = np.asarray(given(model, fields, "light_dir")[sun], float)
  return Light(
    direction / np.linalg.norm(direction),
    float(fields["light_ambient"][sun][0])
    if "light_ambient" in fields
    else plain.ambient,
    float(fields["light_diffuse"][sun][0])
    if "light_diffuse" in fields
    else plain.diffuse,
    fields.get("background", plain.background),
  )


def given(
  model: mujoco.MjModel, fields: dict[str, np.ndarray], name: str
) -> np.ndarray:
  """Returns a field of the model, or what one world has in its place."""
  return np.asarray(fields[name] if name in fields else getattr(model, name))


def color_bytes(rgb: Any) -> np.ndarray:
  """Returns a color f64[3] in [0, 1] as u8[3]."""
  return (255 * np.asarray(rgb, float).clip(0, 1) + 0.5).astype(np.uint8)
