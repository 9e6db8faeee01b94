"""The four algorithms of the paper on all tasks from pixels: curves and a table.

  python experiments/results/pixel_comparison.py --jobs 2              # days
  python experiments/results/pixel_comparison.py --tasks push_plate --seeds 0
  python experiments/results/pixel_comparison.py --tasks push_plate --seeds 0 \
      --rows ap_mpo_mixture ap_sac_mixture

See ``comparison``. A row has the preset of the task, with its environment steps,
updates and candidates. Settings of the rows are those of the trials that solve most in
``search``.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from comparison import Comparison, Row

ROWS = {
  "ap_npql": Row("ap_npql"),
  "ap_mpo": Row(
    "ap_mpo",
    "--agent.policy-initial-std 0.05 --agent.min-alpha 0.0028 "
    "--agent.learning-rate-e 0.00061 --agent.epsilon 2.6 --agent.policy-max-std 0.12",
  ),
  "ap_sac": Row(
    "ap_sac",
    "--agent.policy-initial-std 0.05 --agent.min-alpha 0.0034 "
    "--agent.learning-rate-e 0.00092 --agent.epsilon 35 --agent.policy-max-std 0.5",
  ),
  "sac": Row(
    "sac",
    "--agent.min-alpha 0.0054 --agent.learning-rate-e 0.00044 --agent.epsilon 7.2 "
    "--agent.policy-initial-std 0.25",
  ),
}
# What a parametric policy costs: its projection, or that it is a single Gaussian? Here
# it has as many components as the prior.
ROWS |= {
  f"{name}_mixture": Row(name, f"{ROWS[name].flags} --agent.policy-components 3")
  for name in ("ap_mpo", "ap_sac")
}

EVAL_EVERY = {
  "push_plate": 2_560,
  "stack_box": 20_480,
  "flip_cup": 40_960,
  "place_plate": 10_240,
}
"""Environment steps between evaluations."""


def options(task: str, row: Row, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  options = (
    f"--agent.algorithm {row.algorithm} --seed {seed} --no-video --eval-episodes 128 "
    f"--eval-every {EVAL_EVERY[task]} {row.flags}"
  )
  return options.split()


COMPARISON = Comparison(
  out=Path(__file__).resolve().with_suffix(""),
  sweep=Path("runs/pixel_comparison"),
  rows=ROWS,
  options=lambda task, row, seed: options(task, ROWS[row], seed),
  play="--episodes 512 --bank-seed 1",  # Reset states that no evaluation has seen.
  greedy=lambda row: "mean",
  second="by means",
  axes=("steps", "minutes"),
)


def variant(script: str, rows: dict[str, Row], **changes: Any) -> Comparison:
  """Returns this comparison with other rows, and its results next to a script."""
  out = Path(script).resolve().with_suffix("")
  return dataclasses.replace(
    COMPARISON,
    out=out,
    sweep=Path("runs") / out.name,
    rows=rows,
    options=lambda task, row, seed: options(task, rows[row], seed),
    wanted=tuple(rows),
    **changes,
  )


if __name__ == "__main__":
  COMPARISON.main(__doc__)
