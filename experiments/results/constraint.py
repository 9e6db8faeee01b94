"""The limit on KL(q, b) and the floor on alpha, from states: curves and tables.

  python experiments/results/constraint.py --jobs 2          # hours

See ``comparison``. The paper searched epsilon from 0.5 to 4. At the presets' floor on
alpha of 0.01 it hardly binds (docs/algorithm.md), so most rows have a floor of 0.001,
as a clip, from which alpha can return, or with a softplus, from which it cannot. KL and
alpha at the end of training are in kl.md.
"""

from __future__ import annotations

import dataclasses

from comparison import Found, Row
import pixel_comparison

from apnpql_jax.reports import tables

LIMITS = (0.5, 1, 2, 4)
"""Values of epsilon in nats."""

ROWS = {
  "preset": Row("ap_npql"),
  "softplus_1": Row("ap_npql", "--agent.min-alpha 0.001"),
  **{
    f"clip_{limit:g}": Row(
      "ap_npql",
      f"--agent.min-alpha 0.001 --agent.alpha-floor clip --agent.epsilon {limit:g}",
    )
    for limit in LIMITS
  },
}

METRICS = {
  "KL / epsilon": "npql/kl_over_eps",
  "95th percentile": "npql/kl_over_eps_p95",
  "alpha": "npql/alpha_mean",
  "its 95th percentile": "npql/alpha_p95",
}

STATES = (
  "--env.obs state --env.worlds 32 --env.bank-rows 2048 "
  "--replay.capacity 25600 --replay.expert-steps 25600 "
  # KL(q, b) cannot exceed the log of the candidates, which is 4.2.
  "--agent.target-samples 64 --agent.policy-samples 64 "
  "--total-steps 30720 --agent.decay-updates 7680"
)
"""Options of all rows: four environment steps per update."""


def options(task: str, row: str, seed: int) -> list[str]:
  """Returns the command-line options that change the preset of a task."""
  flags = f"{STATES} {ROWS[row].flags} --eval-every 2560"
  return pixel_comparison.options(task, Row("ap_npql", flags), seed)


COMPARISON = dataclasses.replace(
  pixel_comparison.variant(
    __file__, ROWS, tasks=("stack_box", "flip_cup"), seeds=(0, 1), axes=("steps",)
  ),
  options=options,
)


def at_the_end(found: Found) -> str:
  """Returns a table of the metrics of the last iteration, by seed."""
  rows = [["task", "row", *METRICS]]
  for (task, row), results in found.items():
    last = [result["evaluations"][-1] for result in results]
    shown = (tables.listed(f"{x[name]:.2g}" for x in last) for name in METRICS.values())
    rows.append([task, row, *shown])
  return f"{tables.markdown(rows)}\n"


if __name__ == "__main__":
  COMPARISON.main(__doc__)
  (COMPARISON.out / "kl.md").write_text(at_the_end(COMPARISON.results()))
