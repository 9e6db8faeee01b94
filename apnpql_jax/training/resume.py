"""Resuming a run from its newest readable checkpoint.

A checkpoint holds the training state as three items, so that the replay can be saved
less often than the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import math
from pathlib import Path
import shutil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import LearnerState, make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.errors import FileError, UserError
from apnpql_jax.runs import (
  checkpoint_reader,
  checkpoint_record,
  leaves,
  metrics,
  segments,
)
from apnpql_jax.runs.segments import Ring, Segment
from apnpql_jax.training.state import TrainState


def to_items(state: TrainState, *, whole: bool) -> dict[str, Any]:
  """Returns the items of a checkpoint; the replay, the largest, only if ``whole``."""
  rest = {name: getattr(state, name) for name in ("env", "key", "env_steps", "faults")}
  items: dict[str, Any] = {"learner": state.learner, "rest": rest}
  if whole:
    items["replay"] = {"agent": state.replay, "expert": state.expert_replay}
  return items


def to_rings(state: TrainState, *, chunk: int) -> dict[str, Ring]:
  """Returns the arrays of the item "replay" that are written in segments.

  ``chunk`` is the length of a rollout. Truncation marks are left out, because
  ``replay.exclude`` sets them later.
  """
  length, worlds = state.replay.slots.action.shape[:2]
  added = int(state.env_steps) // worlds
  added += (int(state.replay.cursor) - added) % length  # Passed over by ``_aligned``.
  rings = {"agent": _ring(state.replay, "agent", added, chunk)}
  if state.expert_replay is not None:
    length = len(state.expert_replay.slots.action)
    rings["expert"] = _ring(state.expert_replay, "expert", length, 0)
  return rings


def _ring(ring: Replay, name: str, added: int, chunk: int) -> Ring:
  return Ring(_arrays(ring, name), int(ring.cursor), added, chunk)


def _arrays(ring: Replay, name: str) -> dict[str, Any]:
  """Returns path -> array of what is written in segments."""
  named = leaves.named({"replay": {name: {"slots": ring.slots}}})
  marks = f"replay/{name}/slots/timestep/truncated"
  return {path: x for path, x in named.items() if x.size and path != marks}


def _nbytes(arrays: Iterable[Any]) -> int:
  """Returns the bytes of arrays or ShapeDtypeStructs over all devices."""
  return sum(math.prod(x.shape) * x.dtype.itemsize for x in arrays)


def disk_bytes(
  config: TrainConfig, example: TrainState, resumed: bool
) -> tuple[int, int]:
  """Returns the bytes, before compression, of the next checkpoint and of all at a time.

  These are the newest ones, the best one, and the one being written. They share all
  segments of the expert replay, and those of the replay that do not change meanwhile.
  What a resumed run already has on disk is not counted again.
  """
  agent, expert = (
    0 if ring is None else _nbytes(_arrays(ring, "").values())
    for ring in (example.replay, example.expert_replay)
  )
  rest = _nbytes(jax.tree.leaves(example)) - agent - expert
  every = config.save_replay_every or config.checkpoint_every
  instants = -(-every // config.env.worlds) + config.rollout_length
  length = len(example.replay.slots.action)
  # The parts at both ends of what is new are written whole.
  changed = min(agent, agent * instants // length + 2 * segments.PART_BYTES)
  if resumed:
    return rest + changed, rest + changed
  kept = config.keep_checkpoints
  replays = expert + 2 * agent + kept * changed  # The best one may share nothing.
  return rest + expert + agent, (kept + 2) * rest + replays


class Resumed(NamedTuple):
  """Result of ``restore_run``."""

  state: TrainState
  intact: bool  # whether the segments on disk are what is in the replays


def restore_run(
  config: TrainConfig,
  run_dir: Path,
  example: TrainState,
  warn: Callable[[str], None],
  *,
  refill: Callable[[], Replay | None] | None = None,
) -> Resumed:
  """Returns the newest training state that can be read.

  If segments of the replays are damaged in all checkpoints, their slots are never
  drawn, and those of the expert are made again if possible.

  Args:
    config: Settings of the run.
    run_dir: The run folder.
    example: The state as ShapeDtypeStructs.
    warn: Called with a line for each damaged checkpoint, for an older replay, and for
      lost slots.
    refill: Makes the expert replay of a new run; it is not made if None.
  """
  found = checkpoint_reader.restore(
    run_dir,
    None,
    lambda saved: _saved_items(example, saved, config),
    config=config,
    without_segments=True,
  )
  for line in found.damaged:
    warn(line)
  if found.damaged:
    warn(f"resuming from the checkpoint of step {found.step:,} instead")
  ring, expert = (found.items["replay"][name] for name in ("agent", "expert"))
  lost = {segment.ring: [] for segment in found.lost}
  for segment in found.lost:
    lost[segment.ring].append(segment)
  if "agent" in lost:
    ring, count = _without(ring, lost["agent"])
    warn(f"{count:,} slots of the replay are damaged and left out")
  if "expert" in lost:
    expert = _refilled(expert, lost["expert"], refill, warn)
  if found.steps["replay"] < found.step:
    warn(f"its replay comes from step {found.steps['replay']:,}")
    # The next slots do not continue its newest ones.
    ring = replay.exclude(ring, jnp.ones(config.env.worlds, jnp.int32))
  state = TrainState(
    learner=_with_counters(found.items["learner"], example.learner),
    replay=_aligned(ring, chunk=config.rollout_length),
    expert_replay=expert,
    **found.items["rest"],
  )
  return Resumed(state, not lost)


def _without(ring: Replay, lost: Sequence[Segment]) -> tuple[Replay, int]:
  """Returns the replay with lost slots marked, and the number of those in use."""
  length, worlds = ring.slots.action.shape[:2]
  used = jnp.arange(length) < ring.size
  count = sum(int(used[x.start : x.stop].sum()) for x in lost)
  for segment in lost:
    ring = replay.exclude_lost(ring, segment.start, segment.stop)
  return ring, count * worlds


def _refilled(
  ring: Replay,
  lost: Sequence[Segment],
  refill: Callable[[], Replay | None] | None,
  warn: Callable[[str], None],
) -> Replay:
  """Returns the expert replay made again or, if that fails, without its lost slots.

  Raises:
    FileError: It can neither be made again, nor is anything left of it.
  """
  reason = ""
  try:
    if refill and (made := refill()) is not None:
      warn("the expert replay is damaged and filled again")
      return made
  except UserError as error:
    reason = f" and cannot be filled again ({error})"
  ring, count = _without(ring, lost)
  if bool(ring.slots.timestep.last.all()):
    raise FileError(f"the expert replay is damaged{reason}; nothing of it is left")
  warn(f"{count:,} slots of the expert replay are damaged and left out{reason}")
  return ring


def _saved_items(
  example: TrainState, saved: TrainConfig, config: TrainConfig
) -> dict[str, Any]:
  """Returns the items, as ShapeDtypeStructs, of a run with the settings ``saved``.

  A constant learning rate has no counter of updates, see ``learner.make_optimizer``.
  """
  if bool(saved.agent.decay_updates) != bool(config.agent.decay_updates):
    agent, key = make_agent(saved.agent), jax.random.key(0)
    learner = jax.eval_shape(agent.init, key, example.env.observation)
    where = example.learner.step.sharding
    learner = jax.tree.map(
      lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where), learner
    )
    example = example.replace(learner=learner)
  return to_items(example, whole=True)


def _with_counters(learner: LearnerState, example: LearnerState) -> LearnerState:
  """Returns the learner with the leaves of ``example``.

  A counter of updates that it lacks starts from the number of updates done.
  """
  found = leaves.named(learner)
  wanted = leaves.named(example)
  arrays = {k: found[k] if k in found else jnp.copy(learner.step) for k in wanted}
  return leaves.fill(example, arrays)


def _aligned(ring: Replay, *, chunk: int) -> Replay:
  """Returns a ring whose next chunk begins at a multiple of its length.

  Otherwise a chunk could cross the end, after a resume with another ``rollout_length``.
  The instants that are passed over, the oldest ones or none, are never drawn.
  """
  gap = -int(ring.cursor) % chunk
  if not gap:
    return ring
  length = len(ring.slots.action)
  ring = replay.exclude(ring, jnp.ones(ring.slots.action.shape[1], jnp.int32))
  ring = ring.replace(
    cursor=(ring.cursor + gap) % length, size=jnp.minimum(ring.size + gap, length)
  )
  return replay.exclude(ring, jnp.full(ring.slots.action.shape[1], gap, jnp.int32))


def set_aside(run_dir: Path, step: int) -> Path | None:
  """Moves checkpoints after ``step`` and a copy of the metrics to a folder of the run.

  Replaces what an earlier resume put there.

  Returns:
    The folder, or None if there are no such checkpoints.
  """
  later = [number for number in checkpoint_reader.all_steps(run_dir) if number > step]
  if not later:
    return None
  aside = run_dir / "set_aside"
  shutil.rmtree(aside, ignore_errors=True)
  aside.mkdir()
  for path in metrics.metric_files(run_dir):
    if path.exists():
      shutil.copy2(path, aside)
  for number in later:
    (checkpoint_record.folder(run_dir) / str(number)).rename(aside / str(number))
  return aside
