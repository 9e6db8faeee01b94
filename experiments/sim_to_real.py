"""Preset: put a plate into a box in randomized worlds, for transfer (paper Sec. V-C).

The agent of place_plate with standardized images, in worlds whose table, background and
light vary more than the defaults of domain randomization.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax import RandomizationConfig, load_preset

_PLACE = load_preset("place_plate")

CONFIG = dataclasses.replace(
  _PLACE,
  env=dataclasses.replace(
    _PLACE.env,
    randomize=True,
    randomization=RandomizationConfig(light_level=0.5, surroundings=0.4),
  ),
  agent=dataclasses.replace(
    _PLACE.agent, standardize_images=True, decay_updates=20_480
  ),
  # Randomized images take longer than updates do, so each step serves twice as many.
  updates_per_iteration=64,
  total_steps=81_920,
)
