"""Resuming a run from its newest readable checkpoint.

A checkpoint holds the training state as three items, so that the replay can be saved
less often than the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import shutil
from typing import Any

import jax.numpy as jnp

from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.data.replay import Replay
from apnpql_jax.runs import checkpoint_reader, checkpoint_record, leaves, metrics
from apnpql_jax.runs.segments import Ring
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
  worlds = state.replay.slots.action.shape[1]
  added = int(state.env_steps) // worlds
  rings = {"agent": _ring(state.replay, "agent", added, chunk)}
  if state.expert_replay is not None:
    length = len(state.expert_replay.slots.action)
    rings["expert"] = _ring(state.expert_replay, "expert", length, 0)
  return rings


def _ring(ring: Replay, name: str, added: int, chunk: int) -> Ring:
  named = leaves.named({"replay": {name: {"slots": ring.slots}}})
  marks = f"replay/{name}/slots/timestep/truncated"
  arrays = {path: x for path, x in named.items() if x.size and path != marks}
  return Ring(arrays, int(ring.cursor), added, chunk)


def restore(
  config: TrainConfig, run_dir: Path, example: TrainState, warn: Callable[[str], None]
) -> TrainState:
  """Returns the newest training state that can be read.

  Takes the state as ShapeDtypeStructs, and calls ``warn`` with a line for each damaged
  checkpoint and for an older replay.
  """
  items = to_items(example, whole=True)
  found = checkpoint_reader.restore(run_dir, None, items, config=config)
  for line in found.damaged:
    warn(line)
  if found.damaged:
    warn(f"resuming from the checkpoint of step {found.step:,} instead")
  ring = found.items["replay"]["agent"]
  if found.steps["replay"] < found.step:
    warn(f"its replay comes from step {found.steps['replay']:,}")
    # The next slots do not continue its newest ones.
    ring = replay.exclude(ring, jnp.ones(config.env.worlds, jnp.int32))
  return TrainState(
    learner=found.items["learner"],
    replay=ring,
    expert_replay=found.items["replay"]["expert"],
    **found.items["rest"],
  )


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
