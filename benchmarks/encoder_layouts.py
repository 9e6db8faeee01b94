"""Updates per second by the layout of the encoder, and what share images have of them.

  python benchmarks/encoder_layouts.py --quick
  python benchmarks/encoder_layouts.py --store

Updates of a preset's agent on transitions of noise that differ in how images are looked
at, and in nothing else. "none" is the update with a few numbers in the place of the
images; what others take beyond it is the share of the images. ``--json`` prints one
JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import sys
from typing import Any
from unittest import mock

import timing  # isort: skip  (before JAX: sets threads and cache)
from flax import linen as nn
import jax.numpy as jnp
import learner
import tables

from apnpql_jax import testing
from apnpql_jax.agents import encoder
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import Array

sys.path.append(str(tables.ROOT / "tests"))
from apnpql_jax.testing import random_batch


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__, repeats=15)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, default=64)
  parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
  args = timing.parse(parser)
  config = load_preset(args.preset).agent
  if args.quick:
    args.batch, config = 8, testing.TINY.agent
  header = {"preset": args.preset, "batch": args.batch}
  timing.publish("encoder_layouts", args, measure_all(config, args), **header)


def measure_all(
  config: AgentConfig, args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Figures of every layout, timed in turns."""
  ready = []
  for name in args.layouts:
    layout = LAYOUTS[name]
    transitions = random_batch(0, args.batch, pixels=layout.pixels)
    agent = make_agent(dataclasses.replace(config, **layout.settings))
    parts: dict[str, Any] = {"PATCH": encoder.PATCH} | layout.parts
    with mock.patch.multiple(encoder, **parts):
      ready.append(learner.prepare(agent, transitions))
  measured = timing.measure(ready, repeats=args.repeats)
  for name, updates, times in zip(args.layouts, ready, measured, strict=True):
    yield {"layout": name, **updates.figures("update", times)}


@dataclasses.dataclass(frozen=True)
class Layout:
  """How images are looked at, where that is not what the preset says."""

  settings: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Of the agent."""

  parts: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Of the module ``encoder``, in the place of its own."""

  pixels: bool = True


class Convolutions(encoder.PixelEncoder):
  """The two layers as XLA's convolutions; where it pads an image may differ."""

  @nn.compact
  def __call__(self, image: Array) -> tuple[Array, Array]:
    """See ``PixelEncoder``."""
    first, second = self.channels
    side = 3 if self.overlap else 2
    patches = nn.Conv(first, (4, 4), 4, name="patches")(image / jnp.float32(255))
    x = nn.Conv(second, (side, side), 2, name="conv")(nn.relu(patches))
    points = [encoder.keypoints(layer[..., None, :]) for layer in (patches, x)]
    flat = nn.relu(x).reshape(*image.shape[:-3], -1)
    return flat, jnp.concatenate(points, axis=-1)


XLA = {"PixelEncoder": Convolutions}
LAYOUTS = {
  "none": Layout(pixels=False),
  "4x4 / 4, 2x2 / 2": Layout({"conv_overlap": False}),
  "4x4 / 4, 3x3 / 2": Layout({"conv_overlap": True}),
  "4x4 / 4, 2x2 / 2 by XLA": Layout({"conv_overlap": False}, XLA),
  "4x4 / 4, 3x3 / 2 by XLA": Layout({"conv_overlap": True}, XLA),
  "2x2 / 2, 2x2 / 2": Layout({"conv_overlap": False}, {"PATCH": 2}),
  "8x8 / 8, 2x2 / 2": Layout({"conv_overlap": False}, {"PATCH": 8}),
  "4x4 / 4, 2x2 / 2, maps": Layout(
    {"conv_overlap": False, "global_features": "map", "wrist_features": "map"}
  ),
  "4x4 / 4, 2x2 / 2, residual block": Layout(
    {"conv_overlap": False, "residual_blocks": 1}
  ),
}
"""Kernel / stride of both layers; matrix products unless they are by XLA."""


if __name__ == "__main__":
  main()
