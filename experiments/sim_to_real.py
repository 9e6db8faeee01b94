"""Preset: put a plate into a box in randomized worlds (paper Sec. V-C).

The agent of place_plate with a shadow and the larger images that the paper uses for its
transfer to a real robot.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_PLACE = load_preset("place_plate")

CONFIG = dataclasses.replace(
  _PLACE,
  env=dataclasses.replace(
    _PLACE.env,
    randomize=True,
    shadows=True,
    global_size=(120, 160),
    wrist_size=(60, 107),
  ),
  agent=dataclasses.replace(_PLACE.agent, decay_updates=51_200),
  # Images of this size take 77 kB per slot.
  replay=dataclasses.replace(_PLACE.replay, capacity=25_600, expert_steps=12_800),
  total_steps=409_600,
  eval_every=20_480,
)
