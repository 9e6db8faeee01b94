"""Preset: flip a cup and put it on a mark, from pixels, with the agent of stack_box."""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_STACK = load_preset("stack_box")

CONFIG = dataclasses.replace(
  _STACK, env=dataclasses.replace(_STACK.env, task="flip_cup")
)
