"""Weights of another run with which a new run starts.

The folder of the new run keeps a copy, so it no longer needs the other run.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh
import numpy as np

from apnpql_jax.agents.learner import LearnerState, make_agent
from apnpql_jax.config import changes, files
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import npz
from apnpql_jax.envs.env import observation_shapes
from apnpql_jax.errors import ConfigError, FileError
from apnpql_jax.runs import checkpoint_reader, leaves, provenance, run_folder
from apnpql_jax.runs.segments import to_tree
from apnpql_jax.tasks import make_task
from apnpql_jax.training.placement import shardings
from apnpql_jax.training.state import TrainState

FILE = "initial_weights.npz"
"""Name of the file in the folder of the new run."""

_PARTS = ("params", "target_params")
"""Fields of ``LearnerState`` that are taken over."""

_MAX_BYTES = 8 << 30


class Weights(NamedTuple):
  """Parameters and where they come from."""

  arrays: dict[str, Any]  # path in LearnerState -> array
  origin: dict[str, Any]  # run, step and sha256 of the arrays

  def write(self, run_dir: Path) -> None:
    """Writes the arrays into a run folder."""
    np.savez(run_dir / FILE, **self.arrays)


def check(origin: Path | str, config: TrainConfig) -> None:
  """Checks the weights that ``RUN``, ``RUN:STEP`` or ``RUN:best`` names.

  Raises:
    FileError: There is no such run or checkpoint.
    ConfigError: Its weights do not fit a run with these settings.
  """
  run_dir, step = _parse(origin)
  saved = run_folder.open_run(run_dir).config
  learner = checkpoint_reader.restore(run_dir, step, {}).record.items.get("learner", {})
  held = {k: x.kind for k, x in learner.items() if k.split("/")[0] in _PARTS}
  wanted = _kinds(_example(config, None))
  if held != wanted:
    other = min(k for k in held | wanted if held.get(k) != wanted.get(k))
    diff = files.format_diff(changes.weights_diff(saved, config))
    diff = diff or f"{other} is {held.get(other)}, not {wanted.get(other)}"
    raise ConfigError(f"the weights of {str(run_dir)!r} do not fit: {diff}")


def load(origin: Path | str, config: TrainConfig, mesh: Mesh | None) -> Weights:
  """Reads the weights of a checkpoint that ``check`` accepts.

  It is the one that is the newest or the best now: a run that is training may have
  replaced the one that was checked.

  Raises:
    FileError: They cannot be read.
  """
  run_dir, step = _parse(origin)
  wanted = {"learner": to_tree(_example(config, mesh))}
  found = checkpoint_reader.restore(run_dir, step, wanted, partly=True)
  arrays = {k: np.asarray(x) for k, x in leaves.named(found.items["learner"]).items()}
  run = str(run_dir.absolute())
  return Weights(arrays, {"run": run, "step": found.step, "sha256": _sha256(arrays)})


def read(run_dir: Path) -> Weights | None:
  """Returns the weights that a run without checkpoints starts with.

  Returns None if they are drawn.

  Raises:
    FileError: They cannot be read, or are not those that were written.
  """
  origin = (provenance.read(run_dir) or {}).get("origin")
  if origin is None and not (run_dir / FILE).exists():
    return None
  arrays = npz.read(run_dir / FILE, limit=_MAX_BYTES)
  if not isinstance(origin, dict) or origin.get("sha256") != _sha256(arrays):
    raise FileError(
      f"{run_dir / FILE} is not what {provenance.FILE} describes; start the run again"
    )
  return Weights(arrays, origin)


def put(weights: Weights, state: TrainState) -> TrainState:
  """Returns the state with the weights instead of the drawn ones.

  Raises:
    FileError: They are other arrays than those of the state.
  """
  drawn = {k: getattr(state.learner, k) for k in _PARTS}
  named = leaves.named(drawn)
  if _kinds(named) != _kinds(weights.arrays):
    raise FileError(f"the weights of {weights.origin.get('run')!r} do not fit this run")
  arrays = {k: jax.device_put(weights.arrays[k], x.sharding) for k, x in named.items()}
  return state.replace(learner=state.learner.replace(**leaves.fill(drawn, arrays)))


def _parse(origin: Path | str) -> tuple[Path, int | None]:
  """Returns the run folder and the step; None for the newest."""
  run_dir, step = run_folder.split_origin(origin)
  if step != "best":
    return run_dir, None if step is None else int(step)
  return run_dir, checkpoint_reader.best_step(run_dir)


def _example(config: TrainConfig, mesh: Mesh | None) -> dict[str, Any]:
  """Returns path -> ShapeDtypeStruct of the weights, replicated over the devices."""
  observation = observation_shapes(
    config.env, make_task(config.env.task), lstm_instants=config.agent.lstm_instants
  )
  agent = make_agent(config.agent)
  learner: LearnerState = jax.eval_shape(agent.init, jax.random.key(0), observation)
  parts = {k: getattr(learner, k) for k in _PARTS}
  placed = jax.tree.map(
    lambda x, where: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=where),
    parts,
    shardings(parts, mesh),
  )
  return leaves.named(placed)


def _kinds(arrays: dict[str, Any]) -> dict[str, str]:
  return {path: leaves.kind(x) for path, x in arrays.items()}


def _sha256(arrays: dict[str, np.ndarray]) -> str:
  digest = hashlib.sha256()
  for path, array in sorted(arrays.items()):
    digest.update(f"{path} {leaves.kind(array)}\n".encode())
    digest.update(np.ascontiguousarray(array).tobytes())
  return digest.hexdigest()
