"""Turn a cup over and put it on a mark, from pixels: the agent of push_plate."""

from __future__ import annotations

import dataclasses

from apnpql_jax.presets import load_preset

_PUSH = load_preset("push_plate")

CONFIG = dataclasses.replace(
  _PUSH, env=dataclasses.replace(_PUSH.env, task="flip_cup"), total_steps=102_400
)
