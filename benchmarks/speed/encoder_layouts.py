"""Updates per second by the layout of the encoder, and the share of the images.

  python -m benchmarks.speed.encoder_layouts --quick
  python -m benchmarks.speed.encoder_layouts --store

Updates of a preset's agent on transitions of noise that differ only in the encoder.
"none" has a few numbers in place of the images. The time of a layout beyond "none" is
the share of the images.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
from typing import Any
from unittest import mock

from flax import linen as nn
import jax.numpy as jnp

from apnpql_jax.agents import encoder
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config import TrainConfig
from apnpql_jax.types import Array
from benchmarks.common import command, noise, settings, timing
from benchmarks.speed import learner


def main() -> None:
  """Runs the command line; see the module's docstring."""
  parser = command.parser(__doc__, repeats=15)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, default=64)
  parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
  args = command.parse(parser)
  args.batch = 8 if args.quick else args.batch
  config = settings.preset(args.preset, quick=args.quick)
  config = settings.with_batch(config, args.batch)
  header = {"preset": args.preset, "batch": args.batch}
  command.publish("encoder_layouts", args, measure_all(config, args), **header)


def measure_all(
  config: TrainConfig, args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Yields the figures of every layout, timed in turns."""
  ready = {name: prepare(config, LAYOUTS[name]) for name in args.layouts}
  found = timing.figures("update", ready, repeats=args.repeats)
  for name, figures in found.items():
    yield {"layout": name, **figures}


@dataclasses.dataclass(frozen=True)
class Layout:
  """Differences of an encoder from that of the preset."""

  agent: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Settings of the agent."""

  parts: dict[str, Any] = dataclasses.field(default_factory=dict)
  """Replacements in the module ``encoder``."""

  obs: str = "pixels"


def prepare(config: TrainConfig, layout: Layout) -> timing.Ready:
  """Compiles updates with this encoder."""
  agent = dataclasses.replace(config.agent, **layout.agent)
  env = dataclasses.replace(config.env, obs=layout.obs)
  config = dataclasses.replace(config, agent=agent, env=env)
  parts: dict[str, Any] = {"PATCH": encoder.PATCH} | layout.parts
  with mock.patch.multiple(encoder, **parts):
    return learner.prepare(make_agent(agent), noise.transitions(config))


class Convolutions(encoder.PixelEncoder):
  """The two layers as convolutions of XLA, which may pad images differently."""

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


_APART, _OVERLAP = {"conv_overlap": False}, {"conv_overlap": True}
_MAPS = {"global_features": "map", "wrist_features": "map"}
_XLA = {"PixelEncoder": Convolutions}

LAYOUTS = {
  "none": Layout(obs="state"),
  "4x4 / 4, 2x2 / 2": Layout(_APART),
  "4x4 / 4, 3x3 / 2": Layout(_OVERLAP),
  "4x4 / 4, 2x2 / 2 by XLA": Layout(_APART, _XLA),
  "4x4 / 4, 3x3 / 2 by XLA": Layout(_OVERLAP, _XLA),
  "2x2 / 2, 2x2 / 2": Layout(_APART, {"PATCH": 2}),
  "8x8 / 8, 2x2 / 2": Layout(_APART, {"PATCH": 8}),
  "4x4 / 4, 2x2 / 2, maps": Layout(_APART | _MAPS),
  "4x4 / 4, 2x2 / 2, residual block": Layout(_APART | {"residual_blocks": 1}),
}
"""Kernel / stride of both layers, as matrix products unless "by XLA"."""


if __name__ == "__main__":
  main()
