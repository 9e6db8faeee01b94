"""The command ``apnpql diagnose``."""

from __future__ import annotations

import dataclasses
from typing import Any

from apnpql_jax.cli.inputs import checkpoint_step, existing_run
from apnpql_jax.cli.options import HeldOut


@dataclasses.dataclass(frozen=True)
class Diagnose(HeldOut):
  """Reports where and why an agent fails: apnpql diagnose RUN [options].

  apnpql diagnose runs/mine

  apnpql diagnose runs/mine --checkpoint best --episodes 128 --acting policy
  """

  episodes: int = 64
  """Number of episodes of each acting rule."""

  seed: int = 0
  """Random seed of the episodes and of the policy."""


def diagnose(args: Diagnose) -> dict[str, Any]:
  """Reports what limits the success of a trained agent."""
  run_dir = existing_run(args.run, "diagnose", args.task_file)

  from apnpql_jax.training.diagnose import diagnose as diagnose_run

  return diagnose_run(
    run_dir,
    episodes=args.episodes,
    seed=args.seed,
    backend=args.backend,
    step=checkpoint_step(args.run, args.checkpoint),
    acting=args.acting,
    bank_seed=args.bank_seed,
  )
