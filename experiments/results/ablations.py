"""What each part of AP-NPQL is worth, from pixels: curves and a table.

  python experiments/results/ablations.py --jobs 2                 # a day
  python experiments/results/ablations.py --tasks push_plate --seeds 0

See ``comparison``. A row changes one part of the preset of the task.
"""

from __future__ import annotations

from comparison import Row
import pixel_comparison

NO_Q = "--agent.temperature fixed --agent.initial-alpha 1000"
"""At this alpha q is b, because returns are within 0 and 1."""

ROWS = {
  "ap_npql": Row("ap_npql"),
  # What Q adds: a classifier of the expert's choices instead.
  "ap_dagger": Row("ap_dagger"),
  # What the M-step adds, and what the primitives are worth without it and Q.
  "no_m_step": Row("ap_npql", "--agent.learning-rate-m 0"),
  "primitives_alone": Row("ap_npql", f"{NO_Q} --agent.learning-rate-m 0"),
  # What privileged information adds.
  "no_expert": Row("ap_npql", "--replay.expert-share 0"),
  "static_targets": Row("ap_npql", "--env.static-targets"),
  "arm_primitives": Row("ap_npql", "--agent.no-primitive-gripper"),
  "true_primitives": Row("ap_npql", "--env.true-primitives"),
}

COMPARISON = pixel_comparison.variant(
  __file__,
  ROWS,
  more=("prior",),
  tasks=("push_plate", "flip_cup"),
  seeds=(0, 1),
  axes=("steps",),
)

if __name__ == "__main__":
  COMPARISON.main(__doc__)
