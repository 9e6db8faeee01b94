"""Non-finite updates: stopping the run, and repeating one to debug it.

A skipped update leaves the learner unchanged, and its batch is a function of its key.
The saved update is therefore exactly the one that failed.
"""

from __future__ import annotations

from collections.abc import Container
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
from apnpql_jax.training.iteration import make_sample
from apnpql_jax.training.state import TrainState
from apnpql_jax.types import Observation, Slot, TimeStep, Transition

_MAX_BYTES = 2 << 30
"""Limit of a file to read; a batch of images and a learner take far less."""

_NESTED = {
  "observation_tm1": Observation,
  "observation_t": Observation,
  "observation": Observation,
  "timestep": TimeStep,
  "window": Slot,
}
"""Types of the fields of a transition, and of these, that are not arrays."""

_OPTIONAL = "expert", "expert_tm1"
"""Arrays that only some rows have."""


def check(config: TrainConfig, state: TrainState, run_dir: Path) -> None:
  """Stops a run if its last ``max_skipped_updates`` updates were skipped.

  Raises:
    RunStopped: They were. Learner, batch and key of the last one are saved, and the
      message contains the command that repeats it.
  """
  skipped = int(state.faults.in_a_row)
  if skipped < config.max_skipped_updates:
    return
  path = run_dir / "faults" / f"step_{int(state.env_steps):08d}.npz"
  path.parent.mkdir(exist_ok=True)
  sample_key, learn_key = jax.random.split(state.faults.key)
  sample = make_sample(config, make_agent(config.agent))
  batch = sample(state.replay, state.expert_replay, sample_key)
  update = {"learner": state.learner, "batch": batch, "key": learn_key}
  arrays: dict[str, Any] = multihost_utils.process_allgather(
    leaves.named(leaves.to_plain(update)), tiled=True
  )
  if devices.is_primary():
    np.savez(path, **arrays)
  raise errors.RunStopped(
    f"{skipped} consecutive updates were non-finite; repeat the last one with: "
    f"apnpql repeat {path}",
    errors.FAILED,
  )


def repeat(path: Path) -> dict[str, list[str]]:
  """Repeats a saved update with the settings of its run.

  Returns:
    Names of the non-finite arrays in the batch, in the learner before and
    after the update, and in the metrics.

  Raises:
    FileError: The file was not made by ``check``, or is not in its run folder.
  """
  config = run_folder.load_run_config(path.absolute().parent.parent)
  arrays = npz.read(path, limit=_MAX_BYTES)
  agent = make_agent(config.agent)
  try:
    batch = leaves.fill(_example(Transition, "batch", arrays), _below("batch/", arrays))
    learner = jax.eval_shape(agent.init, jax.random.key(0), batch.observation_tm1)
    learner = leaves.fill(learner, _below("learner/", arrays))
    key = jax.random.wrap_key_data(jnp.asarray(arrays["key"]))
    after, metrics = jax.jit(agent.update)(learner, batch, key)
  except (KeyError, TypeError, ValueError) as error:
    raise FileError(f"{path} is not an update of this run: {one_line(error)}") from None
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


def _example(kind: Any, path: str, names: Container[str]) -> Any:
  """Returns a batch of placeholders, with the optional parts that the file has."""

  def part(field: str) -> Any:
    name = f"{path}/{field}"
    if field == "window" and f"{name}/action" not in names:
      return None
    if field in _NESTED:
      return _example(_NESTED[field], name, names)
    optional = kind is Observation or field in _OPTIONAL
    return None if optional and name not in names else 0

  return kind(**{field: part(field) for field in kind.__dataclass_fields__})


def _not_finite(tree: Any) -> list[str]:
  named = leaves.named(tree)
  return [name for name, x in named.items() if not bool(jnp.isfinite(x).all())]
