"""Replay: a ``[time, world]`` ring buffer that stores each frame once.

The slot at time t holds (TimeStep_t, action_t). Reward and end flags of TimeStep_t
belong to the arrival at t. The slot after a last one is the reset of the next episode.
N-step transitions and windows for an LSTM are assembled at sampling time.
"""

from __future__ import annotations

import functools
from typing import Any

from flax import struct
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int, PRNGKeyArray
import numpy as np

from apnpql_jax.types import Array, Slot, Transition

_CANDIDATES = 4  # starts drawn per row; terminal steps (1 in 20 to 94) are rejected


class Replay(struct.PyTreeNode):
  """A ring buffer of fixed size."""

  slots: Slot  # [length, worlds, ...]
  cursor: Int[Array, ""]  # next time index to write; the oldest one once full
  size: Int[Array, ""]  # stored instants per world, at most length


def create(example_slot: Slot, length: int, worlds: int) -> Replay:
  """Creates an empty ring; the example is one slot of one world, without batch axes."""
  slots = jax.tree.map(
    lambda x: jnp.zeros((length, worlds, *x.shape), x.dtype), example_slot
  )
  # Two separate zeros: a buffer that appears twice cannot be donated.
  return Replay(slots, cursor=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def add(replay: Replay, chunk: Slot) -> Replay:
  """Writes a chunk [T, worlds, ...], oldest first, over the oldest instants.

  All chunks of a ring have the same T, so no write crosses its end. The write is in
  place if the replay is donated and is sampled only afterwards.
  """
  length, steps = replay.slots.action.shape[0], chunk.action.shape[0]
  if not steps or length % steps:
    raise ValueError(f"a chunk of {steps} instants does not divide a ring of {length}")

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


def exclude(replay: Replay, steps: Int[Array, " worlds"]) -> Replay:
  """Marks the newest ``steps`` slots of each world as truncated to exclude an episode.

  No transition starts at a last slot or reaches beyond one, so it is never drawn.
  """
  length = replay.slots.action.shape[0]
  age = (replay.cursor - 1 - jnp.arange(length)) % length
  timestep = replay.slots.timestep
  truncated = timestep.truncated | (age[:, None] < steps[None, :])
  slots = replay.slots.replace(timestep=timestep.replace(truncated=truncated))
  return replay.replace(slots=slots)


def exclude_lost(replay: Replay, start: int, stop: int) -> Replay:
  """Marks the slots at time indices from ``start`` to ``stop`` - 1 as truncated.

  The slot before them is marked, too: it may end a transition but cannot start one. No
  transition touches the lost ones.
  """
  length = replay.slots.action.shape[0]
  marked = (jnp.arange(length) - (start - 1)) % length <= stop - start
  timestep = replay.slots.timestep
  truncated = timestep.truncated | marked[:, None]
  slots = replay.slots.replace(timestep=timestep.replace(truncated=truncated))
  return replay.replace(slots=slots)


@jax.jit
def episodes(replay: Replay) -> tuple[Int[Array, ""], Int[Array, ""]]:
  """Counts successes and finished episodes, at the first of adjacent last slots.

  Excluded slots are last ones. They add one finished episode, or none if they follow an
  end or fill the ring.
  """
  timestep = replay.slots.timestep
  ends = timestep.last & ~jnp.roll(timestep.last, 1, axis=0)
  return jnp.sum(ends & timestep.terminated), jnp.sum(ends)


def can_sample(replay: Replay, *, n_step: int) -> Bool[Array, ""]:
  """Returns whether some slot has ``n_step`` successors."""
  return replay.size > n_step


def sample(
  replay: Replay,
  key: PRNGKeyArray,
  *,
  batch_size: int,
  n_step: int,
  gamma: float,
  windows: bool = False,
  lstm_instants: int = 0,
) -> Transition:
  """Draws N-step transitions uniformly, with replacement, from all valid starts.

  A valid start is a slot that is not last, has N successors and, for windows of L
  observations, L - 1 predecessors. Let m be the first k <= N with a last step at t+k,
  or N. Then reward_t is sum_{k=1..m} gamma^(k-1) r_{t+k}, and discount_t is gamma^m, or
  zero if t+m terminated. The weight is zero where no valid start was found, because the
  ring is too short or all candidates of the batch were used up.

  With ``windows``, ``Transition.window`` holds the N instants after the start; they
  repeat the end of an episode. With ``lstm_instants`` L > 0, observations are
  [B, L, ...].
  """
  before = max(lstm_instants - 1, 0)
  time, world, valid = _draw_starts(replay, key, batch_size, n_step, before)
  length, timestep = replay.slots.action.shape[0], replay.slots.timestep
  steps = jnp.arange(n_step)[None, :]
  window = (time[:, None] + 1 + steps) % length  # [B, N]
  flags = (timestep.reward, timestep.terminated, timestep.truncated)
  reward, terminated, truncated = _gather(flags, window, world[:, None])
  # Find m - 1, the position of the first end; the last column means "none within N".
  stop = jnp.argmax((terminated | truncated).at[:, -1].set(True), axis=1)
  # Discount rewards up to m.
  counted = steps <= stop[:, None]
  powers = jnp.asarray(np.power(gamma, np.arange(n_step + 1)), reward.dtype)
  ended = jnp.take_along_axis(terminated, stop[:, None], axis=1)[:, 0]
  # Gather the start, the state to bootstrap from, and the window between them.
  window = (time[:, None] + 1 + jnp.minimum(steps, stop[:, None])) % length
  slots_at = functools.partial(_slots, replay, lstm_instants=lstm_instants)
  start, end = slots_at(time, world), slots_at(window[:, -1], world)
  return Transition(
    observation_tm1=start.timestep.observation,
    action_tm1=start.action,
    reward_t=jnp.sum(jnp.where(counted, reward, 0.0) * powers[None, :-1], axis=1),
    discount_t=jnp.where(ended, 0.0, powers[stop + 1]),
    observation_t=end.timestep.observation,
    primitives_tm1=start.timestep.primitives,
    weight=valid.astype(reward.dtype),
    window=slots_at(window, world[:, None]) if windows else None,
    expert_tm1=start.timestep.expert,
  )


def expert_count(batch_size: int, expert_share: float) -> int:
  """Returns how many transitions of each batch come from the expert's replay."""
  if not 0.0 <= expert_share <= 1.0:
    raise ValueError(f"expert_share {expert_share} is not within [0, 1]")
  return round(batch_size * expert_share)


def sample_mixed(
  agent_replay: Replay,
  expert_replay: Replay | None,
  key: PRNGKeyArray,
  *,
  batch_size: int,
  expert_share: float,
  n_step: int,
  gamma: float,
  windows: bool = False,
  lstm_instants: int = 0,
) -> Transition:
  """Draws a batch from both replays: agent rows first, then ``expert_count`` rows.

  The counts are fixed. Rows of a replay that is still too short have weight zero, since
  replacing them would change the configured share.
  """
  from_expert = expert_count(batch_size, expert_share)
  if from_expert and expert_replay is None:
    raise ValueError(f"expert_share {expert_share} needs an expert replay")
  counts = ((agent_replay, batch_size - from_expert), (expert_replay, from_expert))
  draw = functools.partial(
    sample, n_step=n_step, gamma=gamma, windows=windows, lstm_instants=lstm_instants
  )
  parts = [
    draw(replay, part_key, batch_size=count)
    for (replay, count), part_key in zip(counts, jax.random.split(key), strict=True)
    if replay is not None and count
  ]
  return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def _draw_starts(
  replay: Replay, key: PRNGKeyArray, batch_size: int, n_step: int, before: int
) -> tuple[Array, Array, Array]:
  """Draws starts by rejection: time index, world and validity, each [B].

  Candidates are independent and uniform over the slots with ``n_step`` successors and
  ``before`` predecessors, so the accepted ones are uniform over the valid starts.
  """
  length, worlds = replay.slots.action.shape[:2]
  key_offset, key_world = jax.random.split(key)
  shape = (_CANDIDATES * batch_size,)
  span = jnp.maximum(replay.size - before - n_step, 1)
  # Offsets count from the oldest slot, so no window crosses the seam.
  offset = jax.random.randint(key_offset, shape, 0, span)
  time = (replay.cursor - replay.size + before + offset) % length
  world = jax.random.randint(key_world, shape, 0, worlds)
  step = replay.slots.timestep
  terminated, truncated = _gather((step.terminated, step.truncated), time, world)
  valid = ~(terminated | truncated) & can_sample(replay, n_step=before + n_step)
  kept = jnp.argsort(~valid, stable=True)[:batch_size]
  return time[kept], world[kept], valid[kept]


def _slots(replay: Replay, time: Array, world: Array, *, lstm_instants: int) -> Slot:
  """Gathers slots at (time, world) [*b], with observations [*b, L, ...] for L instants.

  The slot after the latest earlier end is the first of the episode. If the episode is
  shorter than L, its first observation is repeated.
  """
  slots = _gather(replay.slots, time, world)
  if not lstm_instants:
    return slots
  length, timestep = replay.slots.action.shape[0], replay.slots.timestep
  world = world[..., None]
  earlier = jnp.stack([time - 1 - k for k in range(lstm_instants)], axis=-1) % length
  flags = (timestep.terminated, timestep.truncated)
  terminated, truncated = _gather(flags, earlier, world)
  # Count earlier slots of the episode; the last column means "L - 1 or more".
  before = jnp.argmax((terminated | truncated).at[..., -1].set(True), axis=-1)
  past = [time - jnp.minimum(k, before) for k in reversed(range(lstm_instants))]
  recent = _gather(timestep.observation, jnp.stack(past, axis=-1) % length, world)
  return slots.replace(timestep=slots.timestep.replace(observation=recent))


def _gather(tree: Any, time: Array, world: Array) -> Any:
  """Gathers (time, world) of every leaf; the indices are always within the ring."""
  mode = "promise_in_bounds"
  return jax.tree.map(
    lambda x: x.at[time, world].get(mode=mode, wrap_negative_indices=False), tree
  )
