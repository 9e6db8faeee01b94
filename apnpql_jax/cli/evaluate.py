"""The command ``apnpql evaluate``."""

from __future__ import annotations

import dataclasses
from typing import Any

from apnpql_jax.cli.inputs import checkpoint_step, existing_run
from apnpql_jax.cli.options import HeldOut, Play
from apnpql_jax.cli.outputs import check_free


@dataclasses.dataclass(frozen=True)
class Evaluate(Play, HeldOut):
  """Plays held-out episodes with a trained agent: apnpql evaluate RUN [options].

  apnpql evaluate runs/mine --episodes 200 --seed 7

  apnpql evaluate runs/mine --checkpoint best --video best.mp4
  """


def evaluate(args: Evaluate) -> dict[str, Any]:
  """Plays held-out episodes with a checkpoint of a run."""
  run_dir = existing_run(args.run, "evaluate", args.task_file)
  check_free(args.video, overwrite=args.overwrite)

  from apnpql_jax.training.evaluate import evaluate as evaluate_run

  return evaluate_run(
    run_dir,
    episodes=args.episodes,
    seed=args.seed,
    backend=args.backend,
    step=checkpoint_step(args.run, args.checkpoint),
    acting=args.acting,
    bank_seed=args.bank_seed,
    video=args.video,
  )
