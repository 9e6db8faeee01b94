"""Feature extractor: pixels and states to the shared features phi (Sec. IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
import functools
import math
from typing import Any

from flax import linen as nn
import jax.numpy as jnp
import numpy as np

from apnpql_jax.types import ARM_DOF, Array, Observation

PATCH = 4
"""Side of the pixel patches that the first convolution sees."""

_STEP_SCALE = 7.0
"""Brings a joint's change per control period (0.15 rad at most) to order one."""

_POSITION_SCALE = 5.0
"""Brings positions within reach of the arm (m) to order one, centimeters to 0.05."""

_NEAR = 0.05, 0.2
"""m; distances from the tool within which points are seen in detail."""

_SHARPNESS = 4.0
"""Scales the scores of keypoints: each looks at a part of the image from the start."""


class PixelEncoder(nn.Module):
  """Two convolution layers for one camera, and residual blocks if there shall be any.

  A 4x4 convolution with stride 4, then a 3x3 one with stride 2 (or 2x2 without
  overlap), both written as matrix products: XLA:CPU runs a convolution inside a scan,
  where updates live, up to ten times slower. Images are padded with black to whole
  cells of 8x8 pixels.
  """

  channels: Sequence[int]
  overlap: bool
  residual_blocks: int = 0

  @nn.compact
  def __call__(self, image: Array) -> tuple[Array, Array]:
    """u8[*b, H, W, 3] -> map f32[*b, n], after relu and flattened, not pooled: where a
    thing is must survive; keypoints f32[*b, m] of both layers."""
    first, second = self.channels
    # Rearranged while still bytes, a quarter of the traffic, and by cells of four
    # patches, so that the second layer finds its windows without strided copies.
    cells = space_to_depth(space_to_depth(image, PATCH), 2)
    cells = cells.reshape(*cells.shape[:-1], 4, -1).astype(jnp.float32) / 255.0
    patches = nn.Dense(first, name="patches")(cells)
    cells = nn.relu(patches)
    if self.overlap:
      x = windows(cells)
    else:
      x = cells.reshape(*cells.shape[:-2], -1)
    x = nn.Dense(second, name="conv")(x)
    for i in range(self.residual_blocks):
      x = ResidualBlock(second, name=f"block_{i}")(x)
    points = jnp.concatenate([keypoints(patches), keypoints(x[..., None, :])], axis=-1)
    return nn.relu(x).reshape(*image.shape[:-3], -1), points


class ResidualBlock(nn.Module):
  """f32[*b, H, W, C] -> the same plus two 3x3 convolutions, relu before each (He et
  al. 2016b). Starts as the identity."""

  channels: int

  @nn.compact
  def __call__(self, x: Array) -> Array:
    y = nn.Conv(self.channels, (3, 3), name="first")(nn.relu(x))
    y = nn.Conv(
      self.channels, (3, 3), name="second", kernel_init=nn.initializers.zeros
    )(nn.relu(y))
    return x + y


class Encoder(nn.Module):
  """Feature extractor f^fe: observation -> phi (paper Sec. IV-B).

  Keypoints of a camera are positions and go with those of the robot. A map has its own
  projection, and the projections are summed, so that thousands of pixel features do not
  drown a few dozen of the robot. The layer norm gives phi a fixed scale: the heads that
  read phi without training it (prior, alpha) then follow the encoder instead of chasing
  its growing activations.

  An LSTM, if there is one, reads what would be phi of the last instants of an episode.
  It begins with an empty memory in acting and learning alike. Its last output is phi,
  which lies within -1 and 1.
  """

  feature_dim: int
  channels: Sequence[int]
  overlap: bool
  residual_blocks: int
  global_features: str
  wrist_features: str
  lstm_instants: int

  @nn.compact
  def __call__(self, observation: Observation) -> Array:
    """Observation with batch *b -> f32[*b, feature_dim].

    With an LSTM that reads L instants the observation has [*b, L, ...], oldest first.

    Raises:
      ValueError: it has another number of instants than the LSTM reads.
    """
    body = functools.partial(nn.Dense, self.feature_dim)
    state = [robot_inputs(observation.robot)]
    for positions in (observation.tool, observation.objects):
      if positions is not None:
        state.append(_POSITION_SCALE * positions)
    if observation.objects is not None and observation.tool is not None:
      state.append(seen_from(observation.tool, observation.objects))
    maps = []
    kinds = {"global_image": self.global_features, "wrist_image": self.wrist_features}
    for name, kind in kinds.items():
      image = getattr(observation, name)
      if image is not None:
        look = PixelEncoder(
          self.channels, self.overlap, self.residual_blocks, name=name
        )
        pixels, points = look(image)
        if kind != "map":
          state.append(points)
        if kind != "keypoints":
          maps.append(body(name=f"from_{name}", use_bias=False)(pixels))
    state = nn.relu(body(name="state")(jnp.concatenate(state, axis=-1)))
    x = sum(maps, body(name="from_state")(state))
    x = nn.relu(nn.LayerNorm(name="norm")(x))
    if not self.lstm_instants:
      return x
    if x.shape[-2:-1] != (self.lstm_instants,):
      raise ValueError(f"features {x.shape} are not of {self.lstm_instants} instants")
    cell = nn.OptimizedLSTMCell(self.feature_dim, name="lstm")
    outputs: Any = nn.RNN(cell, unroll=self.lstm_instants)(x)
    return outputs[..., -1, :]


def keypoints(scores: Array) -> Array:
  """Where in the image each channel scores highest (spatial soft-argmax).

  The expected position under a softmax over the map (Levine et al. 2016): a position
  seen in one place of the image is understood in all others.

  Args:
    scores: f32[*b, R, S, P, C], cells of one position, or of the four 00, 01, 10, 11.

  Returns:
    f32[*b, 2 C] within [-1, 1], the row and the column of each channel.
  """
  *batch, rows, columns, parts, channels = scores.shape
  side = math.isqrt(parts)
  down, across = (np.stack(np.divmod(np.arange(parts), side)) + 0.5) / side
  row = 2.0 * (np.arange(rows)[:, None, None] + down) / rows - 1.0
  column = 2.0 * (np.arange(columns)[:, None] + across) / columns - 1.0
  where = np.stack(np.broadcast_arrays(row, column), axis=-1).reshape(-1, 2)
  flat = _SHARPNESS * scores.reshape(*batch, rows * columns * parts, channels)
  share = nn.softmax(flat, axis=-2)
  points = jnp.einsum("...pc,pd->...cd", share, where.astype(np.float32))
  return points.reshape(*batch, 2 * channels)


def seen_from(tool: Array, points: Array) -> Array:
  """Where points are from the tool, the more exactly the nearer they are.

  A millimeter decides whether a hand can close, and is lost among the half meter of a
  table.

  Args:
    tool: f32[*b, 3], m.
    points: f32[*b, 3 k], m.

  Returns:
    f32[*b, 6 k] within [-1, 1].
  """
  away = points.reshape(*points.shape[:-1], -1, 3) - tool[..., None, :]
  squashed = jnp.stack([jnp.tanh(away / near) for near in _NEAR], axis=-1)
  return squashed.reshape(*points.shape[:-1], -1)


def robot_inputs(robot: Array) -> Array:
  """Network inputs of order one from the stacked robot state.

  Args:
    robot: f32[*b, 3 * 7], the last three (6 joint angles, gripper angle), newest
      last, in rad.

  Returns:
    f32[*b, 33]: newest state, sine and cosine of its joints, the last two changes.
  """
  stack = robot.reshape(*robot.shape[:-1], 3, ARM_DOF + 1)
  newest = stack[..., -1, :]
  changes = _STEP_SCALE * (stack[..., 1:, :] - stack[..., :-1, :])
  joints = newest[..., :ARM_DOF]
  return jnp.concatenate(
    [newest, jnp.sin(joints), jnp.cos(joints), changes.reshape(*robot.shape[:-1], -1)],
    axis=-1,
  )


def space_to_depth(image: Array, size: int) -> Array:
  """Moves size x size patches into channels, padding bottom and right with zeros.

  [*b, H, W, C] -> [*b, ceil(H / size), ceil(W / size), size * size * C].
  """
  *batch, height, width, channels = image.shape
  pad = [(0, 0)] * len(batch) + [(0, -height % size), (0, -width % size), (0, 0)]
  image = jnp.pad(image, pad)
  rows, columns = image.shape[-3] // size, image.shape[-2] // size
  image = image.reshape(*batch, rows, size, columns, size, channels)
  return jnp.swapaxes(image, -4, -3).reshape(*batch, rows, columns, -1)


def windows(cells: Array) -> Array:
  """The 3x3 windows, with stride 2 and zero padding, of a map stored by 2x2 cells.

  Args:
    cells: f32[*b, R, S, 4, C], the positions 00, 01, 10, 11 of each cell.

  Returns:
    f32[*b, R, S, 9 C]: the whole cell, then the touching column of the right
    neighbor, the touching row of the one below, and the corner of the diagonal one.
  """
  own = cells.reshape(*cells.shape[:-2], -1)
  border = [(0, 0)] * (cells.ndim - 4) + [(0, 1), (0, 1), (0, 0), (0, 0)]
  padded = jnp.pad(cells, border)
  right, below = padded[..., :-1, 1:, :, :], padded[..., 1:, :-1, :, :]
  corner = padded[..., 1:, 1:, 0, :]
  touching = [right[..., 0, :], right[..., 2, :], below[..., 0, :], below[..., 1, :]]
  return jnp.concatenate([own, *touching, corner], axis=-1)
