"""Unseen looks: appearances of the world that domain randomization cannot draw.

They were fixed before any policy was trained for them, and they are never tuned: a
change of what this file draws needs a new ``VERSION``. Randomization draws plain,
checkered and wavy surfaces, one white light without shadows of objects, and no noise.
Unseen looks have grained surfaces, two colored lights with shadows and highlights,
objects that belong to no task, and the faults of a camera. Everything is a function of
the version and of the row of the reset bank.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import functools

import mujoco
import numpy as np

VERSION = 1

PARTS = ("surfaces", "lights", "shadows", "clutter", "camera")
"""Parts of an unseen look: textures of table, robot and objects; two colored lights and
highlights; shadows; things and walls around the workspace; faults of the cameras. What
a look lacks is as in the scene file."""

TABLES, SURFACES = 4, 6
"""Numbers of textures of tables and of other things."""

SIDE = 128
"""Side of a texture in texels."""

_CLUTTER = (4, 9)
"""Least number of objects, and the first number that is too large."""

_SHAPES = "BOX CYLINDER CAPSULE ELLIPSOID SPHERE".split()


@dataclasses.dataclass(frozen=True)
class Clutter:
  """An object next to the workspace, without contact."""

  shape: int  # ``mujoco.mjtGeom``
  size: np.ndarray  # f64[3], MuJoCo half sizes, m
  pos: np.ndarray  # f64[3], m
  mat: np.ndarray  # f64[9]
  rgb: np.ndarray  # f64[3]
  surface: int


@dataclasses.dataclass(frozen=True)
class Look:
  """What one world looks like."""

  table: int  # texture of the table
  table_rgb: np.ndarray  # f64[3], factor
  surfaces: np.ndarray  # int[nbody], texture of each body
  ambient: float
  sun_dir: np.ndarray  # f64[3], of travel
  sun_rgb: np.ndarray  # f64[3]
  lamp_pos: np.ndarray  # f64[3], m
  lamp_rgb: np.ndarray  # f64[3]
  specular: float
  backdrop: np.ndarray  # f64[3], color of the walls
  clutter: tuple[Clutter, ...]
  gain: np.ndarray  # f64[2, 3], of the color channels of each camera
  gamma: float
  vignette: float  # share of the brightness that corners lose
  blur: float  # share of a pixel that comes from its four neighbors
  noise: tuple[float, float]  # standard deviations of read and shot noise


@functools.lru_cache(maxsize=256)
def draw(row: int, bodies: int) -> Look:
  """Returns the look of the world at a row of the reset bank.

  Args:
    row: The row.
    bodies: Number of bodies of the model.
  """
  rng = np.random.default_rng([VERSION, row])
  warm = rng.uniform(-1, 1)
  tint = np.array([1.0 + 0.18 * warm, 1.0, 1.0 - 0.18 * warm])
  angle = rng.uniform(0, 2 * np.pi)
  lamp_angle = rng.uniform(0, 2 * np.pi)
  lamp = [0.5 + 0.6 * np.cos(lamp_angle), 0.6 * np.sin(lamp_angle), 1.2]
  slope = rng.uniform(0.5, 1.2)
  return Look(
    table=int(rng.integers(TABLES)),
    table_rgb=rng.uniform(0.7, 1.0) * rng.uniform(0.9, 1.0, 3),
    surfaces=rng.integers(SURFACES, size=bodies),
    ambient=rng.uniform(0.3, 0.45),
    sun_dir=np.array([slope * np.cos(angle), slope * np.sin(angle), -1.0]),
    sun_rgb=rng.uniform(0.35, 0.55) * tint,
    lamp_pos=np.array(lamp) + rng.uniform(-0.15, 0.15, 3),
    lamp_rgb=rng.uniform(0.2, 0.4) * tint[::-1],
    specular=rng.uniform(0.1, 0.5),
    backdrop=rng.uniform(0.1, 0.9, 3),
    clutter=tuple(_clutter(rng) for _ in range(rng.integers(*_CLUTTER))),
    gain=rng.uniform(0.88, 1.08, (2, 3)),
    gamma=rng.uniform(0.85, 1.15),
    vignette=rng.uniform(0.0, 0.25),
    blur=rng.uniform(0.0, 0.4),
    noise=(rng.uniform(0.005, 0.02), rng.uniform(0.01, 0.03)),
  )


def _clutter(rng: np.random.Generator) -> Clutter:
  """Draws an object on the table, left or right of the workspace or behind it."""
  shape = getattr(mujoco.mjtGeom, f"mjGEOM_{rng.choice(_SHAPES)}")
  size = rng.uniform(0.015, 0.05, 3)
  turn = rng.uniform(0, 2 * np.pi)
  if rng.random() < 0.7:
    where = [rng.uniform(0.2, 0.8), rng.choice([-1, 1]) * rng.uniform(0.36, 0.5)]
  else:
    where = [rng.uniform(0.76, 0.9), rng.uniform(-0.35, 0.35)]
    size *= 0.6  # Nearer to the camera, and not in front of the workspace.
  along = {"CYLINDER": size[1], "CAPSULE": size[0] + size[1], "SPHERE": size[0]}
  height = along.get(shape.name.removeprefix("mjGEOM_"), size[2])
  mat = np.array([np.cos(turn), -np.sin(turn), 0, np.sin(turn), np.cos(turn), 0])
  return Clutter(
    shape=int(shape),
    size=size,
    pos=np.array([*where, height]),
    mat=np.append(mat, [0, 0, 1]),
    rgb=rng.uniform(0.05, 0.95, 3),
    surface=int(rng.integers(SURFACES)),
  )


def table_texture(index: int) -> np.ndarray:
  """Returns a colored texture u8[SIDE, SIDE, 3]: wood, stone, cloth or terrazzo."""
  rng = np.random.default_rng([VERSION, 1, index])
  if index == 0:  # Grain along one axis.
    rings = _smooth(rng, 2, 24) + 0.3 * _smooth(rng, 4, 64)
    mix = 0.5 + 0.5 * np.sin(14 * rings)
    return _blend(mix, (0.42, 0.27, 0.15), (0.72, 0.52, 0.33))
  if index == 1:  # Veins.
    veins = np.abs(_smooth(rng, 4, 4) + 0.5 * _smooth(rng, 12, 12))
    return _blend(np.clip(3 * veins, 0, 1), (0.35, 0.36, 0.40), (0.86, 0.86, 0.84))
  if index == 2:  # Threads.
    row, column = np.indices((SIDE, SIDE))
    threads = np.where((row // 4 + column // 4) % 2, row % 4, column % 4) / 3
    mix = 0.6 * threads + 0.4 * rng.random((SIDE, SIDE))
    return _blend(mix, (0.25, 0.33, 0.38), (0.52, 0.60, 0.62))
  chips, chosen = _smooth(rng, 10, 10), _smooth(rng, 14, 14) > 0.8
  colors = _blend(0.5 + 0.4 * chips, (0.30, 0.24, 0.22), (0.62, 0.60, 0.52))
  return np.where(chosen[..., None], colors, np.uint8(190))


def surface_texture(index: int) -> np.ndarray:
  """Returns a gray texture u8[6 SIDE, SIDE, 3] of the faces of a cube."""
  rng = np.random.default_rng([VERSION, 2, index])
  faces = []
  for _ in range(6):
    scratches = _smooth(rng, 2 + 20 * (index % 2), 40)
    stains = _smooth(rng, 5, 5)
    mix = 0.5 + 0.25 * scratches + 0.35 * (index % 3) / 2 * stains
    faces.append(_blend(np.clip(mix, 0, 1), (0.55,) * 3, (1.0,) * 3))
  return np.concatenate(faces)


def photograph(
  image: np.ndarray, look: Look, camera: int, rng: np.random.Generator
) -> np.ndarray:
  """Adds the faults of a camera to an image.

  Args:
    image: u8[H, W, 3].
    look: What decides on color, vignetting, blur and noise.
    camera: Index of the camera.
    rng: Source of the noise.
  """
  x = (image.astype(np.float64) / 255) ** look.gamma
  padded = np.pad(x, ((1, 1), (1, 1), (0, 0)), mode="edge")
  around = padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]
  x = (1 - look.blur) * x + look.blur / 4 * around
  rows, columns = (np.linspace(-1, 1, n) ** 2 for n in x.shape[:2])
  x *= 1 - look.vignette / 2 * (rows[:, None] + columns)[..., None]
  x *= look.gain[camera]
  read, shot = look.noise
  x += rng.normal(size=x.shape) * np.sqrt(read**2 + shot**2 * np.maximum(x, 0))
  return (255 * x.clip(0, 1) + 0.5).astype(np.uint8)


def _smooth(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
  """Returns noise f64[SIDE, SIDE] that repeats, with so many waves along each axis."""
  spectrum = np.fft.rfft2(rng.normal(size=(SIDE, SIDE)))
  down = np.fft.fftfreq(SIDE)[:, None] * SIDE / rows
  across = np.fft.rfftfreq(SIDE) * SIDE / columns
  noise = np.fft.irfft2(spectrum * np.exp(-(down**2) - across**2), (SIDE, SIDE))
  return noise / noise.std()


def _blend(mix: np.ndarray, *ends: Sequence[float]) -> np.ndarray:
  """Returns u8[H, W, 3] between two colors in [0, 1], by a share f64[H, W]."""
  low, high = np.array(ends)
  return (255 * (low + mix.clip(0, 1)[..., None] * (high - low))).astype(np.uint8)
