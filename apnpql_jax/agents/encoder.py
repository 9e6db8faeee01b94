"""Feature extractor: pixels and states to the shared features phi (Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
import functools
import math
from typing import Any

from flax import linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float, UInt8
import numpy as np

from apnpql_jax.agents.layers import PositionwiseDense
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import ARM_DOF, Array, Observation

PATCH = 4  # side of the pixel patches that the first convolution reads
_STEP_SCALE = 7.0  # per rad; a joint moves at most 0.15 rad in a control period
_POSITION_SCALE = 5.0  # per m; brings positions within reach of the arm to order one
_NEAR = 0.05, 0.2  # m; distances from the tool within which points are seen in detail
_SHARPNESS = 4.0  # scale of scores that makes keypoints local before training


class PixelEncoder(nn.Module):
  """Two convolution layers for one camera, optionally with residual blocks.

  A 4x4 convolution with stride 4, then a 3x3 one with stride 2 (or 2x2 without
  overlap), both written as matrix products: inside a scan, where updates run, XLA:CPU
  runs a convolution up to ten times slower. Images are padded to cells of 8x8 pixels.

  With ``standardize``, each image has mean 0 and deviation 1 in each color channel, so
  that features hardly depend on exposure and white balance.
  """

  channels: Sequence[int]
  overlap: bool
  residual_blocks: int = 0
  standardize: bool = False

  @nn.compact
  def __call__(
    self, image: UInt8[Array, "*b H W 3"]
  ) -> tuple[Float[Array, "*b n"], Float[Array, "*b m"]]:
    """Returns the map, flattened to keep positions, and keypoints of both layers."""
    first, second = self.channels
    if self.standardize:  # Black borders would depend on the brightness.
      image = pad_to_multiple(image, 2 * PATCH, mode="edge")
    # Rearrange bytes, a quarter of the memory traffic, into cells of four patches, so
    # that the second layer finds its windows without strided copies.
    cells = space_to_depth(space_to_depth(image, PATCH), 2)
    cells = cells.reshape(*cells.shape[:-1], 4, -1).astype(jnp.float32)
    if self.standardize:
      mean, std = (jnp.tile(x, PATCH**2) for x in channel_moments(image))
      cells = (cells - _per_cell(mean)) / _per_cell(std)
    scale = 1.0 if self.standardize else 1.0 / 255.0
    patches = PositionwiseDense(first, input_scale=scale, name="patches")(cells)
    cells = nn.relu(patches)
    x = windows(cells) if self.overlap else cells.reshape(*cells.shape[:-2], -1)
    x = PositionwiseDense(second, name="conv")(x)
    for i in range(self.residual_blocks):
      x = ResidualBlock(second, name=f"block_{i}")(x)
    points = jnp.concatenate([keypoints(patches), keypoints(x[..., None, :])], axis=-1)
    return nn.relu(x).reshape(*image.shape[:-3], -1), points


class ResidualBlock(nn.Module):
  """Two 3x3 convolutions around a skip; starts as the identity (He et al. 2016b)."""

  channels: int

  @nn.compact
  def __call__(self, x: Float[Array, "*b H W C"]) -> Float[Array, "*b H W C"]:
    """Adds the output of the convolutions to ``x``."""
    y = nn.Conv(self.channels, (3, 3), name="first")(nn.relu(x))
    zeros = nn.initializers.zeros
    y = nn.Conv(self.channels, (3, 3), name="second", kernel_init=zeros)(nn.relu(y))
    return x + y


class Encoder(nn.Module):
  """Feature extractor f^fe: observation -> phi (paper Sec. IV-B).

  Keypoints join the positions of the robot. Each map has its own projection, and the
  projections are summed, so that thousands of pixel features do not outweigh a few
  dozen of the robot. The layer norm gives phi a fixed scale: heads that read phi
  without training it (prior, alpha) need not follow growing activations.

  The optional LSTM reads the features of the last L instants of an episode. Its state
  starts at zero, both in acting and in learning. Its last output is phi.
  """

  config: AgentConfig

  @nn.compact
  def __call__(self, observation: Observation) -> Float[Array, "*b feature_dim"]:
    """Computes phi; with an LSTM, from observations [*b, L, ...], oldest first."""
    config = self.config
    body = functools.partial(nn.Dense, config.feature_dim)
    tool, objects = observation.tool, observation.objects
    state = [robot_inputs(observation.robot)]
    state += [_POSITION_SCALE * x for x in (tool, objects) if x is not None]
    if objects is not None and tool is not None:
      state.append(seen_from(tool, objects))
    # Encode the images: keypoints join the state, maps are projected.
    maps, channels = [], (config.patch_channels, config.conv_channels)
    camera = functools.partial(
      PixelEncoder,
      channels,
      config.conv_overlap,
      config.residual_blocks,
      standardize=config.standardize_images,
    )
    for name, image, kind in (
      ("global_image", observation.global_image, config.global_features),
      ("wrist_image", observation.wrist_image, config.wrist_features),
    ):
      if image is not None:
        pixels, points = camera(name=name)(image)
        if kind != "map":
          state.append(points)
        if kind != "keypoints":
          maps.append(body(name=f"from_{name}", use_bias=False)(pixels))
    # Sum the projections and normalize.
    state = nn.relu(body(name="state")(jnp.concatenate(state, axis=-1)))
    x = sum(maps, body(name="from_state")(state))
    x = nn.relu(nn.LayerNorm(name="norm")(x))
    instants = config.lstm_instants
    if not instants:
      return x
    if x.shape[-2:-1] != (instants,):
      raise ValueError(f"features {x.shape} do not have {instants} instants")
    cell = nn.OptimizedLSTMCell(config.feature_dim, name="lstm")
    outputs: Any = nn.RNN(cell, unroll=instants)(x)
    return outputs[..., -1, :]


def keypoints(scores: Float[Array, "*b R S P C"]) -> Float[Array, "*b 2*C"]:
  """Locates each channel's highest score by a spatial soft-argmax (Levine et al. 2016).

  Returns row and column within [-1, 1], so what later layers learn in one part of the
  image carries over to others. A cell has one position, or the four 00, 01, 10, 11.
  """
  *batch, rows, columns, parts, channels = scores.shape
  # Find the center of every position, as (row, column) within [-1, 1].
  side = math.isqrt(parts)
  down, across = (np.stack(np.divmod(np.arange(parts), side)) + 0.5) / side
  row = 2.0 * (np.arange(rows)[:, None, None] + down) / rows - 1.0
  column = 2.0 * (np.arange(columns)[:, None] + across) / columns - 1.0
  where = np.stack(np.broadcast_arrays(1.0, row, column)).reshape(3, -1)
  # Average the centers under the softmax of each channel. One product sums numerators
  # and denominators, and needs no transposed copy of the map.
  flat = _SHARPNESS * scores.reshape(-1, rows * columns * parts, channels)
  highest = jax.lax.stop_gradient(jnp.max(flat, axis=-2, keepdims=True))
  where = jnp.broadcast_to(where.astype(np.float32), (len(flat), *where.shape))
  sums = where @ jnp.exp(flat - highest)
  points = sums[:, 1:] / sums[:, :1]
  return jnp.swapaxes(points, -1, -2).reshape(*batch, 2 * channels)


def seen_from(
  tool: Float[Array, "*b 3"], points: Float[Array, "*b 3*k"]
) -> Float[Array, "*b 6*k"]:
  """Returns offsets of points from the tool (m), squashed to [-1, 1] at two scales.

  Near the tool, resolution is highest: a millimeter decides whether the hand can close.
  """
  away = points.reshape(*points.shape[:-1], -1, 3) - tool[..., None, :]
  squashed = jnp.stack([jnp.tanh(away / near) for near in _NEAR], axis=-1)
  return squashed.reshape(*points.shape[:-1], -1)


def robot_inputs(robot: Float[Array, "*b 21"]) -> Float[Array, "*b 33"]:
  """Converts the last three robot states (rad), newest last, to inputs of order one.

  These are the newest state, sine and cosine of its joints, and the last two changes.
  """
  stack = robot.reshape(*robot.shape[:-1], 3, ARM_DOF + 1)
  newest = stack[..., -1, :]
  changes = _STEP_SCALE * (stack[..., 1:, :] - stack[..., :-1, :])
  joints = newest[..., :ARM_DOF]
  sine, cosine = jnp.sin(joints), jnp.cos(joints)
  inputs = [newest, sine, cosine, changes.reshape(*robot.shape[:-1], -1)]
  return jnp.concatenate(inputs, axis=-1)


def channel_moments(
  image: UInt8[Array, "*b H W 3"],
) -> tuple[Float[Array, "*b 3"], Float[Array, "*b 3"]]:
  """Returns mean and standard deviation (at least 1) of each color channel."""
  pixels = image.astype(jnp.float32)
  mean, std = jnp.mean(pixels, axis=(-3, -2)), jnp.std(pixels, axis=(-3, -2))
  return mean, jnp.maximum(std, 1.0)


def _per_cell(x: Float[Array, "*b n"]) -> Float[Array, "*b 1 1 1 n"]:
  """Adds the axes of the rows, columns and parts of a map that is stored by cells."""
  return x[..., None, None, None, :]


def pad_to_multiple(image: Array, size: int, mode: str = "constant") -> Array:
  """Pads bottom and right of [*b, H, W, C] to multiples of ``size``."""
  height, width = image.shape[-3:-1]
  batch = [(0, 0)] * (image.ndim - 3)
  pad = [*batch, (0, -height % size), (0, -width % size), (0, 0)]
  return jnp.pad(image, pad, mode=mode)


def space_to_depth(image: Array, size: int) -> Array:
  """Moves size x size patches into channels, padding bottom and right with zeros.

  [*b, H, W, C] -> [*b, ceil(H / size), ceil(W / size), size * size * C].
  """
  *batch, _, _, channels = image.shape
  image = pad_to_multiple(image, size)
  rows, columns = image.shape[-3] // size, image.shape[-2] // size
  image = image.reshape(*batch, rows, size, columns, size, channels)
  return jnp.swapaxes(image, -4, -3).reshape(*batch, rows, columns, -1)


def windows(cells: Float[Array, "*b R S 4 C"]) -> Float[Array, "*b R S 9*C"]:
  """Extracts 3x3 windows, stride 2 with zero padding, from a map stored by 2x2 cells.

  A window is a cell (00, 01, 10, 11), then the touching column of its right neighbor,
  the touching row of the neighbor below, and the touching corner of the diagonal one.
  """
  own = cells.reshape(*cells.shape[:-2], -1)
  border = [(0, 0)] * (cells.ndim - 4) + [(0, 1), (0, 1), (0, 0), (0, 0)]
  padded = jnp.pad(cells, border)
  right, below = padded[..., :-1, 1:, :, :], padded[..., 1:, :-1, :, :]
  corner = padded[..., 1:, 1:, 0, :]
  touching = [right[..., 0, :], right[..., 2, :], below[..., 0, :], below[..., 1, :]]
  return jnp.concatenate([own, *touching, corner], axis=-1)
