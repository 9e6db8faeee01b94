"""Preset: put a plate from its holder into a box, from pixels.

The agent of stack_box, which needs half as many updates here.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_STACK = load_preset("stack_box")

CONFIG = dataclasses.replace(
  _STACK,
  env=dataclasses.replace(_STACK.env, task="place_plate"),
  agent=dataclasses.replace(_STACK.agent, decay_updates=7_680),
  total_steps=61_440,
  eval_every=10_240,
)
