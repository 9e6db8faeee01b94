"""The identity of a result: everything that determines its episodes.

Two results with the same identity come from the same worlds and the same policy.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any
import zlib

from apnpql_jax.config.schema import EnvConfig, TrainConfig
from apnpql_jax.runs import checkpoint_record
from apnpql_jax.tasks import make_task
from apnpql_jax.transfer.condition import Condition


def of_expert(
  config: EnvConfig, condition: Condition, *, episodes: int, seed: int
) -> dict[str, Any]:
  """Returns the identity of a result of the scripted expert."""
  return {
    **_of_worlds(config),
    **condition.about(),
    "algorithm": "expert",
    "episodes": episodes,
    "seed": seed,
  }


def of_run(
  run_dir: Path,
  config: TrainConfig,
  step: int,
  condition: Condition,
  *,
  acting: str | None,
  episodes: int,
  seed: int,
) -> dict[str, Any]:
  """Returns the identity of a result of a run's policy.

  Args:
    run_dir: The run folder.
    config: Its settings.
    step: The step of the checkpoint.
    condition: What the worlds consist of.
    acting: Rule that chooses actions; that of the run's evaluations if None.
    episodes: Number of episodes.
    seed: Random seed of the episodes and of the policy.

  Raises:
    FileError: The record of the checkpoint cannot be read.
  """
  learner = checkpoint_record.read(run_dir, step).items.get("learner", {})
  return {
    **_of_worlds(config.env),
    **condition.about(),
    "algorithm": config.agent.algorithm,
    "trained": "randomized" if config.env.randomize else "plain",
    "checkpoint_step": step,
    "weights_crc32": _crc32(learner),
    "acting": acting or config.eval_acting,
    "episodes": episodes,
    "seed": seed,
  }


def _of_worlds(config: EnvConfig) -> dict[str, Any]:
  """Returns task and scene, and a checksum of the settings of worlds and images."""
  # A condition chooses the physics, and a task may be read from any folder.
  fields = dataclasses.asdict(config)
  used = {k: x for k, x in fields.items() if k not in ("backend", "task_file")}
  return {
    "task": config.task,
    "scene_sha256": make_task(config.task).scene.fingerprint,
    "env_crc32": _crc32(used),
  }


def _crc32(value: Any) -> int:
  return zlib.crc32(json.dumps(value, sort_keys=True).encode())
