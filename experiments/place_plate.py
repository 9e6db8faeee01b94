"""Preset: put a plate from its holder into a box, from pixels, as stack_box."""

from __future__ import annotations

import dataclasses

from apnpql_jax import load_preset

_STACK = load_preset("stack_box")

CONFIG = dataclasses.replace(
  _STACK, env=dataclasses.replace(_STACK.env, task="place_plate")
)
