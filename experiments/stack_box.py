"""Preset: stack the yellow box on the blue one, from pixels.

Grasping needs the differences from push_plate; see `experiments/log.md`.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_PUSH = load_preset("push_plate")

CONFIG = dataclasses.replace(
  _PUSH,
  # Grasps need many scenes: worlds at once, and reset states to draw from.
  env=dataclasses.replace(_PUSH.env, task="stack_box", worlds=64, bank_rows=8_192),
  agent=dataclasses.replace(_PUSH.agent, min_prob=0.02),
  replay=dataclasses.replace(_PUSH.replay, capacity=51_200, expert_steps=51_200),
  total_steps=81_920,
  eval_every=20_480,
  checkpoint_every=20_480,
)
