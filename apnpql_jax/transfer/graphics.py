"""Cameras, light, colors and image processing that the renderers share."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from apnpql_jax.config.schema import EnvConfig
from apnpql_jax.render import Lighting
from apnpql_jax.sim.graphics import area_resized
from apnpql_jax.transfer import looks

CAMERAS = ("global", "wrist")
OVERSAMPLING = 2
"""Pixels that are rendered per pixel of an image, along each axis."""


class Light(NamedTuple):
  """The light of a world without an unseen look; colors are in [0, 1]."""

  direction: np.ndarray  # f64[3], of travel, a unit vector
  ambient: float
  diffuse: float
  background: Any  # color [3]


def light_of(model: mujoco.MjModel, fields: dict[str, np.ndarray]) -> Light:
  """Returns the light of one world from its ``PhysicsState.fields``."""
  sun, plain = Lighting.from_model(model).id, Lighting()
  levels = {"ambient": plain.ambient, "diffuse": plain.diffuse}
  for name in levels:
    if f"light_{name}" in fields:
      levels[name] = float(fields[f"light_{name}"][sun][0])
  direction = np.asarray(field_of(model, fields, "light_dir")[sun], float)
  background = fields.get("background", plain.background)
  return Light(direction / np.linalg.norm(direction), **levels, background=background)


def field_of(
  model: mujoco.MjModel, fields: dict[str, np.ndarray], name: str
) -> np.ndarray:
  """Returns a field of the model, or what one world has in its place."""
  return np.asarray(fields[name] if name in fields else getattr(model, name))


def color_bytes(rgb: Any) -> np.ndarray:
  """Returns a color f64[3] in [0, 1] as u8[3]."""
  return (255 * np.asarray(rgb, float).clip(0, 1) + 0.5).astype(np.uint8)


def rendered_sizes(config: EnvConfig) -> list[tuple[int, int]]:
  """Returns height and width, in pixels, in which each camera is rendered."""
  sizes = config.global_size, config.wrist_size
  return [(OVERSAMPLING * height, OVERSAMPLING * width) for height, width in sizes]


def developed(
  pixels: np.ndarray, look: looks.Look | None, row: int, instant: int, camera: int
) -> np.ndarray:
  """Returns the agent's image of rendered pixels, u8[H, W, 3].

  Args:
    pixels: u8[OVERSAMPLING H, OVERSAMPLING W, 3].
    look: Adds the faults of a camera, if any.
    row: Row of the reset bank.
    instant: Instant of the episode; it decides on the noise, together with ``row``.
    camera: Index in ``CAMERAS``.
  """
  image = area_resized(pixels, OVERSAMPLING)
  if look is None:
    return image
  rng = np.random.default_rng([looks.VERSION, row, instant, camera])
  return looks.photograph(image, look, camera, rng)
