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
  # Rates that decay to the end keep the success of the last third from swinging.
  agent=dataclasses.replace(_PUSH.agent, min_prob=0.02, decay_updates=15_360),
  replay=dataclasses.replace(_PUSH.replay, capacity=51_200, expert_steps=51_200),
  total_steps=122_880,
  eval_every=20_480,
  checkpoint_every=20_480,
)
