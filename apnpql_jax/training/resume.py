"""Where a run goes on: its newest whole checkpoint, and what came after that.

A checkpoint holds the training state as three items, so that the replay may be saved
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
from apnpql_jax.runs import checkpoint_reader, checkpoint_record, metrics
from apnpql_jax.training.state import TrainState


def to_items(state: TrainState, *, whole: bool) -> dict[str, Any]:
  """The parts of a checkpoint; the replay, by far the largest, only if ``whole``."""
  rest = {name: getattr(state, name) for name in ("env", "key", "env_steps", "faults")}
  items: dict[str, Any] = {"learner": state.learner, "rest": rest}
  if whole:
    items["replay"] = {"agent": state.replay, "expert": state.expert_replay}
  return items


def restore(
  config: TrainConfig, run_dir: Path, example: TrainState, say: Callable[[str], None]
) -> TrainState:
  """The newest state that can be read; undoes ``to_items``.

  Args:
    config: as of ``checkpoint.restore``.
    run_dir: the run folder.
    example: the same state as ShapeDtypeStructs.
    say: is told which checkpoints could not be used, and what is older than the rest.
  """
  items = to_items(example, whole=True)
  found = checkpoint_reader.restore(run_dir, None, items, config=config)
  for line in found.damaged:
    say(line)
  if found.damaged:
    say(f"going on from the checkpoint before, {found.step}")
  ring = found.items["replay"]["agent"]
  if found.steps["replay"] < found.step:
    say(f"its replay is that of step {found.steps['replay']:,}")
    # What comes next does not follow on its newest slots.
    ring = replay.exclude(ring, jnp.ones(config.env.worlds, jnp.int32))
  return TrainState(
    learner=found.items["learner"],
    replay=ring,
    expert_replay=found.items["replay"]["expert"],
    **found.items["rest"],
  )


def set_aside(run_dir: Path, step: int) -> Path | None:
  """Puts away checkpoints after ``step``: their future will now be another one.

  With the metrics so far they move to a folder of the run, in place of what an earlier
  resume put there.

  Returns:
    the folder; None, and nothing is done, if there are no such checkpoints.
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
