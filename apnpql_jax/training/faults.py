"""Updates that were not finite: when to stop for them, and how to repeat one.

A skipped update leaves the learner as it was, and its batch follows from its key: what
is written is therefore exactly what went wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
from jax.experimental import multihost_utils
import jax.numpy as jnp
import numpy as np

from apnpql_jax import devices, errors
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import npz
from apnpql_jax.errors import FileError, one_line
from apnpql_jax.runs import leaves, run_folder
from apnpql_jax.runs.run_folder import RunFolder
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.training.state import TrainState
from apnpql_jax.types import Observation, Slot, TimeStep, Transition

_MAX_BYTES = 2 << 30
"""A batch of images and a learner take far less."""


def check(config: TrainConfig, state: TrainState, folder: RunFolder) -> None:
  """Stops a run whose updates are skipped one after the other.

  Raises:
    RunStopped: the last ``max_skipped_updates`` were; the message names the file with
      the batch, and the command that repeats the update.
  """
  skipped = int(state.faults.in_a_row)
  if skipped < config.max_skipped_updates:
    return
  folder.faults.mkdir(exist_ok=True)
  path = folder.faults / f"step_{int(state.env_steps):08d}.npz"
  write(path, config, state)
  raise errors.RunStopped(
    f"{skipped} updates in a row were not finite; repeat the last one with: "
    f"apnpql repeat {path}",
    errors.FAILED,
  )


def write(path: Path, config: TrainConfig, state: TrainState) -> None:
  """Saves the learner, the batch and the key of the last update that was skipped."""
  sample_key, learn_key = jax.random.split(state.faults.key)
  sample = make_sample(config, make_agent(config.agent))
  batch = sample(state.replay, state.expert_replay, sample_key)
  update = {"learner": state.learner, "batch": batch, "key": learn_key}
  arrays: dict[str, Any] = multihost_utils.process_allgather(
    leaves.named(leaves.to_plain(update)), tiled=True
  )
  if devices.is_primary():
    np.savez(path, **arrays)


def repeat(path: Path) -> dict[str, list[str]]:
  """Takes the update of a file of ``write`` again, with the settings of its run.

  Returns:
    names of what was not finite: in the batch, in the learner before and after the
    update, and among the metrics.

  Raises:
    FileError: it is no such file, or does not lie in its run folder.
  """
  config = run_folder.load_run_config(path.absolute().parent.parent)
  arrays = npz.read(path, limit=_MAX_BYTES)
  agent = make_agent(config.agent)
  try:
    batch = leaves.fill(_example_batch(arrays), _below("batch/", arrays))
    learner = jax.eval_shape(agent.init, jax.random.key(0), batch.observation_tm1)
    learner = leaves.fill(learner, _below("learner/", arrays))
    key = jax.random.wrap_key_data(jnp.asarray(arrays["key"]))
    after, metrics = jax.jit(agent.update)(learner, batch, key)
  except (KeyError, TypeError, ValueError) as error:
    raise FileError(f"{path} is no update of this run: {one_line(error)}") from None
  return {
    "batch": _not_finite(batch),
    "learner_before": _not_finite(learner),
    "learner_after": _not_finite(after),
    "metrics": _not_finite(metrics),
  }


def _below(prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, jax.Array]:
  return {
    name.removeprefix(prefix): jnp.asarray(array)
    for name, array in arrays.items()
    if name.startswith(prefix)
  }


def _example_batch(arrays: dict[str, np.ndarray]) -> Transition:
  """A transition that has the modalities the file has."""

  def observation(name: str) -> Observation:
    fields = Observation.__dataclass_fields__
    held: dict[str, Any]
    held = {f: 0 if f"batch/{name}/{f}" in arrays else None for f in fields}
    return Observation(**held)

  def filled(kind: Any, **given: Any) -> Any:
    return kind(**dict.fromkeys(kind.__dataclass_fields__, 0) | given)

  window = None
  if "batch/window/action" in arrays:
    seen = observation("window/timestep/observation")
    window = filled(Slot, timestep=filled(TimeStep, observation=seen))
  return filled(
    Transition,
    observation_tm1=observation("observation_tm1"),
    observation_t=observation("observation_t"),
    window=window,
  )


def _not_finite(tree: Any) -> list[str]:
  named = leaves.named(tree)
  return [name for name, x in named.items() if not bool(jnp.isfinite(x).all())]
