"""Ranges of domain randomization (paper Sec. V-C) and their limits.

Part of the configuration; ``randomization`` draws within them.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax.config import codec
from apnpql_jax.errors import ConfigError

_MAX_RELATIVE = 0.5
"""Upper limit of the ranges not listed below, as a fraction of the nominal value."""

_MAX_ABSOLUTE = {
  "color": 1.0,
  "surroundings": 1.0,
  "texture": 1.0,
  "light_turn": 0.9,
  "camera_shift": 0.2,
  "camera_turn": 0.3,
  "table_height": 0.1,
  "table_tilt": 0.1,
  "size": 0.1,
  "shape": 0.1,
  "damping": 2.0,
  "delay_s": 1.0,
}
"""Upper limits in the units of the settings."""

_MAX_SIZE, _MAX_SIZE_AND_SHAPE = 0.07, 0.09
"""Upper limits in new runs. A box of stack_box that is 8 % too wide or too narrow does
not count as held, and two that are 10 % too high or too low not as stacked."""

WRIST_SHARE = 0.1
"""Shift of the wrist camera, as a share of that of the global camera."""


@dataclasses.dataclass(frozen=True)
class RandomizationConfig:
  """Largest deviation of each property from the scene file (paper Sec. V-C).

  Takes effect with ``randomize``. Deviations are uniform, drawn per world and episode.
  Relative ranges are fractions of the nominal value; 0 switches a property off.
  """

  color: float = 0.15
  """RGB of robot, table, background and each object, on a scale of 0 to 1."""

  texture: float = 0.2
  """Largest color change by checkers and noise on robot, table, background and each
  object, on a scale of 0 to 1. Each is plain, checkered or noisy, at equal odds."""

  light_turn: float = 0.4
  """Direction of the light: each component of its unit vector."""

  light_level: float = 0.3
  """Ambient and direct light, relative."""

  camera_shift: float = 0.02
  """Position of the global camera along each axis in m; a tenth for the wrist's."""

  camera_turn: float = 0.02
  """Orientation of the cameras about each axis in rad."""

  field_of_view: float = 0.03
  """Field of view of the cameras, relative."""

  table_height: float = 0.015
  """Height of the table below the robot in m."""

  table_tilt: float = 0.01
  """Tilt of the table against the robot's base about both horizontal axes in rad."""

  table_turn: float = 0.05
  """Rotation of the table and all objects about the robot's vertical axis in rad."""

  size: float = 0.05
  """Size of each object, relative."""

  shape: float = codec.added(0.04, before=0.0)
  """Height-to-width ratio of each object, relative; flip_cup also has three cups."""

  mass: float = 0.3
  """Mass of each object, relative."""

  friction: float = 0.2
  """One factor on the friction of all contacts, relative."""

  damping: float = 0.2
  """Joint damping added to the robot's in 1/s (torque per velocity and joint inertia),
  drawn from 0 to this."""

  delay_s: float = 0.03
  """Delay from a command to its effect in seconds, drawn from 0 to this."""

  gripper_speed: float = 0.2
  """Speed of the gripper, relative."""

  surroundings: float = codec.added(0.0)
  """RGB of table and background beyond ``color``, on a scale of 0 to 1."""


def validate_ranges(ranges: RandomizationConfig, prefix: str) -> None:
  """Checks that every range is within its limits.

  Raises:
    ConfigError: A range is negative or too large; the message prepends ``prefix`` to
      its name.
  """
  for name, value in codec.flatten(ranges):
    limit = _MAX_ABSOLUTE.get(name, _MAX_RELATIVE)
    if not 0.0 <= value <= limit:
      raise ConfigError(f"{prefix}{name}={value} must be within [0, {limit}]")


def check_sizes(ranges: RandomizationConfig) -> None:
  """Checks that all tasks work with the objects of a new run; older runs still load.

  Raises:
    ConfigError: The range of sizes is too large, alone or together with that of shapes.
  """
  both = round(ranges.size + ranges.shape, 6)
  if ranges.size > _MAX_SIZE or both > _MAX_SIZE_AND_SHAPE:
    name = "env.randomization."
    raise ConfigError(
      f"{name}size={ranges.size} must be at most {_MAX_SIZE}, and with "
      f"{name}shape={ranges.shape} at most {_MAX_SIZE_AND_SHAPE}"
    )
