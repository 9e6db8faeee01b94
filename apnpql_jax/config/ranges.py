"""Ranges of domain randomization (paper Sec. V-C): settings, and how far they may go.

Part of the configuration, hence without JAX; ``worlds`` draws within them.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax.config import codec
from apnpql_jax.errors import ConfigError

MAX_SHARE = 0.5
"""Largest range of a share: nothing shrinks to nothing."""

MAX_ABSOLUTE = {
  "color": 1.0,
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
"""Largest ranges of the others, in their units; objects of other sizes and shapes than
these neither fit into the hand nor into what they are put into."""


@dataclasses.dataclass(frozen=True)
class RandomizationConfig:
  """How far each property of a world may be from the scene file (paper Sec. V-C).

  Counts where ``randomize`` is set; a range of 0 switches its property off. All are
  drawn uniformly, per world and episode. A share is of the property's own value.
  """

  color: float = 0.15
  """Red, green and blue of robot, table, background and each object, of 1."""

  texture: float = 0.2
  """Checkers and noise on robot, table, background and each object: largest change of a
  color, of 1. A third each are plain, checkered and noisy."""

  light_turn: float = 0.4
  """Direction of the light, each component of its unit vector."""

  light_level: float = 0.3
  """Ambient and direct light, each a share."""

  camera_shift: float = 0.02
  """Position of the global camera along each axis, m; of that on the wrist a tenth."""

  camera_turn: float = 0.02
  """Orientation of the cameras about each axis, rad."""

  field_of_view: float = 0.03
  """Field of view of the cameras, a share."""

  table_height: float = 0.015
  """Height of the table under the robot, m."""

  table_tilt: float = 0.01
  """Inclination of the table to the robot's base about both level axes, rad."""

  table_turn: float = 0.05
  """Direction of the table, with all that is on it, as seen from the robot, rad."""

  size: float = 0.05
  """Size of each object, a share."""

  shape: float = codec.added(0.04, before=0.0)
  """Height of each object to its width, a share; flip_cup has cups of three shapes
  anyway."""

  mass: float = 0.3
  """Mass of each object, a share."""

  friction: float = 0.2
  """Friction of all contacts together, a share."""

  damping: float = 0.2
  """Joint damping added to the robot's, upwards from none, 1/s: torque per velocity and
  inertia of the joint."""

  delay_s: float = 0.03
  """Time from a command to its effect, upwards from none, s."""

  gripper_speed: float = 0.2
  """Speed of the gripper, a share."""


def validate_ranges(ranges: RandomizationConfig, prefix: str) -> None:
  """Raises ConfigError where a range cannot be; ``prefix`` stands before its name."""
  for name, value in codec.flatten(ranges):
    most = MAX_ABSOLUTE.get(name, MAX_SHARE)
    if not 0.0 <= value <= most:
      raise ConfigError(f"{prefix}{name}={value} must be within [0, {most}]")
