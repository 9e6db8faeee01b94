"""Updates per second by the layout of the encoder, and the share of the images.

  python -m benchmarks.speed.encoder_layouts --store

Updates of a preset's agent on transitions of noise that differ only in the encoder.
"none" has a few numbers in place of the images. The time of a layout beyond "none" is
the share of the images.
"""

import argparse
from collections.abc import Iterator
from typing import Any
from unittest import mock

from flax import linen as nn
import jax.numpy as jnp

from apnpql_jax.agents import encoder
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.types import Array
from benchmarks.common import command, noise, settings, timing
from benchmarks.speed import learner

Result = dict[str, Any]


def main() -> None:
  parser = command.parser(__doc__, repeats=15)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, default=64)
  parser.add_argument("--candidates", type=int, default=120)
  parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
  args = command.parse(parser)
  if args.quick:
    args.batch, args.candidates = 8, 8
  config = settings.preset(args.preset, quick=args.quick)
  config = settings.changed(config, "replay", batch_size=args.batch)
  config = settings.with_candidates(config, args.candidates)
  header = {name: getattr(args, name) for name in ("preset", "batch", "candidates")}
  header["candidate_precision"] = config.agent.candidate_precision
  command.publish("encoder_layouts", args, measure_all(config, args), **header)


def measure_all(config: TrainConfig, args: argparse.Namespace) -> Iterator[Result]:
  """Yields the figures of every layout, timed in turns."""
  ready = {name: prepare(config, *LAYOUTS[name]) for name in args.layouts}
  found = timing.figures("update", ready, repeats=args.repeats)
  for name, figures in found.items():
    yield {"layout": name, **figures}


def prepare(
  config: TrainConfig, obs: str, agent: Result, parts: Result
) -> timing.Ready:
  """Compiles updates with other settings of the agent and parts of ``encoder``."""
  config = settings.changed(config, "agent", **agent)
  config = settings.changed(config, "env", obs=obs)
  patches: Result = {"PATCH": encoder.PATCH} | parts
  with mock.patch.multiple(encoder, **patches):
    return learner.prepare(make_agent(config.agent), noise.transitions(config))


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


_APART: Result = {"conv_overlap": False}
_OVERLAP: Result = {"conv_overlap": True}
_MAPS = {"global_features": "map", "wrist_features": "map"}
_BLOCK, _XLA = {"residual_blocks": 1}, {"PixelEncoder": Convolutions}

LAYOUTS: dict[str, tuple[str, Result, Result]] = {
  "none": ("state", {}, {}),
  "4x4 / 4, 2x2 / 2": ("pixels", _APART, {}),
  "4x4 / 4, 3x3 / 2": ("pixels", _OVERLAP, {}),
  "4x4 / 4, 2x2 / 2 by XLA": ("pixels", _APART, _XLA),
  "4x4 / 4, 3x3 / 2 by XLA": ("pixels", _OVERLAP, _XLA),
  "2x2 / 2, 2x2 / 2": ("pixels", _APART, {"PATCH": 2}),
  "8x8 / 8, 2x2 / 2": ("pixels", _APART, {"PATCH": 8}),
  "4x4 / 4, 2x2 / 2, maps": ("pixels", _APART | _MAPS, {}),
  "4x4 / 4, 2x2 / 2, residual block": ("pixels", _APART | _BLOCK, {}),
}
"""Kernel / stride of both layers, as matrix products unless "by XLA"."""


if __name__ == "__main__":
  main()
