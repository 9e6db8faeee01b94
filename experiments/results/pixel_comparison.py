"""The four algorithms of the paper on all tasks from pixels: curves and a table.

  python experiments/results/pixel_comparison.py --jobs 2              # days
  python experiments/results/pixel_comparison.py --tasks push_plate --seeds 0

See ``comparison``. A row has the preset of the task, with its environment steps,
updates and candidates. Settings of the rows are those that a search from states found
(experiments/log.md, sac1 to sac4).
"""

from __future__ import annotations

from pathlib import Path

from comparison import Comparison, Row

# Parametric policies start as narrow as the prior is at its widest.
NARROW = "--agent.policy-initial-std 0.05"

ROWS = {
  "ap_npql": Row("ap_npql"),
  "ap_mpo": Row("ap_mpo", NARROW),
  "ap_sac": Row("ap_sac", f"{NARROW} --agent.epsilon 50 --agent.min-alpha 0.001"),
  "sac": Row("sac", "--agent.epsilon 10 --agent.min-alpha 0.001"),
}

EVAL_EVERY = {
  "push_plate": 2_560,
  "stack_box": 20_480,
  "flip_cup": 40_960,
  "place_plate": 10_240,
}
"""Environment steps between evaluations."""


def options_of(task: str, row: str, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  algorithm, flags, _ = ROWS[row]
  options = (
    f"--agent.algorithm {algorithm} --seed {seed} --no-video --eval-episodes 128 "
    f"--eval-every {EVAL_EVERY[task]} {flags}"
  )
  return options.split()


COMPARISON = Comparison(
  out=Path(__file__).resolve().with_suffix(""),
  sweep=Path("runs/pixel_comparison"),
  rows=ROWS,
  options=options_of,
  play="--episodes 512 --bank-seed 1",  # Reset states that no evaluation has seen.
  greedy=lambda row: "mean",
  axes=("steps", "minutes"),
)

if __name__ == "__main__":
  COMPARISON.main(__doc__)
