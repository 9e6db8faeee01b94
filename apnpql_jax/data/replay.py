"""Replay: a ``[time, world]`` ring that keeps each frame once.

A slot at time t holds (TimeStep_t, action_t); the reward and the end flags of
TimeStep_t were received on arriving at t, and the slot after a last one is the
reset of the next episode. N-step transitions are put together when they are drawn,
so that no frame is stored twice and N can change without collecting again. So are
observations of several instants, for agents with an LSTM.
"""

from __future__ import annotations

import functools
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
import numpy as np

from apnpql_jax.types import Array, Slot, Transition

_CANDIDATES = 4
"""Starts drawn per row; those where an episode ended (1 in 20 to 94) are refused."""


class Replay(struct.PyTreeNode):
  """Ring buffer of fixed size; every leaf keeps the dtype of its slot."""

  slots: Slot  # [length, worlds, ...]
  cursor: Array  # i32[]: time index written next; the oldest one once full
  size: Array  # i32[]: time steps held, at most length


def create(example_slot: Slot, length: int, worlds: int) -> Replay:
  """An empty ring of ``length`` time steps of ``worlds`` worlds each.

  ``example_slot`` is one slot of one world, without batch axes; only its shapes and
  dtypes are read, so that ShapeDtypeStructs do.
  """
  slots = jax.tree.map(
    lambda x: jnp.zeros((length, worlds, *x.shape), x.dtype), example_slot
  )
  # Two arrays, not one twice: a buffer that appears twice cannot be donated.
  return Replay(slots, cursor=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def add(replay: Replay, chunk: Slot) -> Replay:
  """Writes a chunk [T, worlds, ...], oldest first, over the oldest time steps.

  It must follow on what was added before. All chunks of one replay must have the same
  T: as T divides the length, no write then crosses the end of the ring. In place if
  the replay is donated and, within one jit, sampled only after adding.

  Raises:
    ValueError: at trace time, if T does not divide the length or if a leaf has
      another shape or dtype than the ring.
  """
  length, steps = replay.slots.action.shape[0], chunk.action.shape[0]
  if not steps or length % steps:
    raise ValueError(f"a chunk of {steps} steps does not divide {length} time steps")

  def write(ring: Array, new: Array) -> Array:
    expected = (steps, *ring.shape[1:])
    if new.shape != expected or new.dtype != ring.dtype:
      raise ValueError(
        f"chunk leaf is {new.dtype}{new.shape}, the ring takes {ring.dtype}{expected}"
      )
    return jax.lax.dynamic_update_slice_in_dim(ring, new, replay.cursor, axis=0)

  return Replay(
    slots=jax.tree.map(write, replay.slots, chunk),
    cursor=(replay.cursor + steps) % length,
    size=jnp.minimum(replay.size + steps, length),
  )


def exclude(replay: Replay, steps: Array) -> Replay:
  """Marks the newest ``steps`` (i32[worlds]) slots of each world as truncated.

  No transition starts at a slot that is last, and neither it nor its window reaches
  beyond one, so that an episode excluded from its first slot on is never drawn.
  """
  length = replay.slots.action.shape[0]
  age = (replay.cursor - 1 - jnp.arange(length)) % length
  timestep = replay.slots.timestep
  truncated = timestep.truncated | (age[:, None] < steps[None, :])
  slots = replay.slots.replace(timestep=timestep.replace(truncated=truncated))
  return replay.replace(slots=slots)


@jax.jit
def episodes(replay: Replay) -> tuple[Array, Array]:
  """Episodes whose end is held, i32[]: those that ended in success, and all.

  One that is excluded, all slots of which are last, counts once.
  """
  timestep = replay.slots.timestep
  ends = timestep.last & ~jnp.roll(timestep.last, 1, axis=0)
  return jnp.sum(ends & timestep.terminated), jnp.sum(ends)


def can_sample(replay: Replay, *, n_step: int) -> Array:
  """bool[]: a slot with ``n_step`` slots after it is held."""
  return replay.size > n_step


def sample(
  replay: Replay,
  key: Array,
  *,
  batch_size: int,
  n_step: int,
  gamma: float,
  windows: bool = False,
  instants: int = 0,
) -> Transition:
  """Draws N-step transitions uniformly, with replacement, over all valid starts.

  A start is any slot that is not last, has ``n_step`` slots after it and, with
  ``instants``, all but one of those before it. The reward
  is sum_{k=1..m} gamma^(k-1) r_{t+k}, where m is the first k with a last step at
  t+k and N if there is none; the discount is gamma^m, zero if t+m terminated.

  Args:
    replay: the ring; with one key it gives one batch.
    key: PRNG key.
    batch_size: transitions B.
    n_step: N, at least 1.
    gamma: discount per control period.
    windows: also return the N instants after the start; past an end of the episode
      that end again, as what follows may be excluded. Without it
      ``Transition.window`` is None.
    instants: L; each observation is [B, L, ...], as ``EnvState.observation``. 0: that of
      the instant alone.

  Returns:
    Transition [B, ...], weights zero where the ring holds no start yet and where four
    candidates per row held fewer than B valid starts.
  """
  before = max(instants - 1, 0)
  time, world, valid = _draw_starts(replay, key, batch_size, n_step, before)
  length, timestep = replay.slots.action.shape[0], replay.slots.timestep
  steps = jnp.arange(n_step)[None, :]
  window = (time[:, None] + 1 + steps) % length  # [B, N]
  flags = (timestep.reward, timestep.terminated, timestep.truncated)
  reward, terminated, truncated = _gather(flags, window, world[:, None])
  # m - 1: position of the first end; the last column stands for "none within N".
  stop = jnp.argmax((terminated | truncated).at[:, -1].set(True), axis=1)
  counted = steps <= stop[:, None]
  powers = jnp.asarray(np.power(gamma, np.arange(n_step + 1)), reward.dtype)
  ended = jnp.take_along_axis(terminated, stop[:, None], axis=1)[:, 0]
  window = (time[:, None] + 1 + jnp.minimum(steps, stop[:, None])) % length
  look = functools.partial(_slots, replay, instants=instants)
  start, end = look(time, world), look(window[:, -1], world)
  return Transition(
    observation_tm1=start.timestep.observation,
    action_tm1=start.action,
    reward_t=jnp.sum(jnp.where(counted, reward, 0.0) * powers[None, :-1], axis=1),
    discount_t=jnp.where(ended, 0.0, powers[stop + 1]),
    observation_t=end.timestep.observation,
    primitives_tm1=start.timestep.primitives,
    weight=valid.astype(reward.dtype),
    window=look(window, world[:, None]) if windows else None,
  )


def expert_count(batch_size: int, expert_share: float) -> int:
  """Transitions of a batch that come from the expert replay, the same every time."""
  if not 0.0 <= expert_share <= 1.0:
    raise ValueError(f"expert_share {expert_share} is not within [0, 1]")
  return round(batch_size * expert_share)


def sample_mixed(
  agent_replay: Replay,
  expert_replay: Replay | None,
  key: Array,
  *,
  batch_size: int,
  expert_share: float,
  n_step: int,
  gamma: float,
  windows: bool = False,
  instants: int = 0,
) -> Transition:
  """``sample`` of both replays: agent rows first, then ``expert_count`` expert rows.

  The counts never change: rows of a replay still too small to draw from have weight
  zero. Filling them from the other would silently change the configured share.
  Without expert rows the expert replay may be None (ValueError otherwise).
  """
  from_expert = expert_count(batch_size, expert_share)
  if from_expert and expert_replay is None:
    raise ValueError(f"expert_share {expert_share} needs an expert replay")
  counts = ((agent_replay, batch_size - from_expert), (expert_replay, from_expert))
  draw = functools.partial(
    sample, n_step=n_step, gamma=gamma, windows=windows, instants=instants
  )
  parts = [
    draw(replay, part_key, batch_size=count)
    for (replay, count), part_key in zip(counts, jax.random.split(key), strict=True)
    if replay is not None and count
  ]
  return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _draw_starts(
  replay: Replay, key: Array, batch_size: int, n_step: int, before: int
) -> tuple[Array, Array, Array]:
  """Time index, world and validity, each [B]. Draws candidates, keeps valid ones first.

  Candidates are independent and uniform over the slots with n_step after and
  ``before`` before them, hence those kept are so over the valid ones.
  """
  length, worlds = replay.slots.action.shape[:2]
  key_offset, key_world = jax.random.split(key)
  shape = (_CANDIDATES * batch_size,)
  span = jnp.maximum(replay.size - before - n_step, 1)
  # Offsets count from the oldest slot, so that no window reaches across the seam.
  offset = jax.random.randint(key_offset, shape, 0, span)
  time = (replay.cursor - replay.size + before + offset) % length
  world = jax.random.randint(key_world, shape, 0, worlds)
  step = replay.slots.timestep
  terminated, truncated = _gather((step.terminated, step.truncated), time, world)
  valid = ~(terminated | truncated) & can_sample(replay, n_step=before + n_step)
  kept = jnp.argsort(~valid, stable=True)[:batch_size]
  return time[kept], world[kept], valid[kept]


def _slots(replay: Replay, time: Array, world: Array, *, instants: int) -> Slot:
  """Slots at (time, world) [*b]; with L ``instants``, observations are [*b, L, ...].

  The episode of a slot begins after the newest end before it; where it is shorter than
  L, its first observation is repeated.
  """
  slots = _gather(replay.slots, time, world)
  if not instants:
    return slots
  length, timestep = replay.slots.action.shape[0], replay.slots.timestep
  world = world[..., None]
  earlier = jnp.stack([time - 1 - k for k in range(instants)], axis=-1) % length
  flags = (timestep.terminated, timestep.truncated)
  terminated, truncated = _gather(flags, earlier, world)
  # Slots of the episode before this one; the last column stands for "L - 1 or more".
  before = jnp.argmax((terminated | truncated).at[..., -1].set(True), axis=-1)
  past = [time - jnp.minimum(k, before) for k in reversed(range(instants))]
  seen = _gather(timestep.observation, jnp.stack(past, axis=-1) % length, world)
  return slots.replace(timestep=slots.timestep.replace(observation=seen))


def _gather(tree: Any, time: Array, world: Array) -> Any:
  """Slots at (time, world) of every leaf; the indices are known to be in the ring."""
  mode = "promise_in_bounds"
  return jax.tree.map(
    lambda x: x.at[time, world].get(mode=mode, wrap_negative_indices=False), tree
  )
