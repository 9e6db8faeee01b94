"""Preset: flip a cup and put it on a mark, from pixels.

The agent of stack_box, which needs nearly three times as many updates here.
"""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_STACK = load_preset("stack_box")

CONFIG = dataclasses.replace(
  _STACK,
  env=dataclasses.replace(_STACK.env, task="flip_cup"),
  agent=dataclasses.replace(_STACK.agent, decay_updates=40_960),
  total_steps=327_680,
  eval_every=40_960,
  checkpoint_every=40_960,
)
