"""A search for settings of the paper's algorithms, from pixels: curves and a table.

  python experiments/results/search.py --jobs 2        # hours
  python experiments/results/search.py --rows ap_mpo_1 ap_mpo_2

See ``comparison``. The budget is the same for every algorithm: the settings of
``state_comparison`` (row_0) and TRIALS points of a Latin hypercube over four settings
(row_1, ...), on push_plate with one seed. The preset itself was made for AP-NPQL over
many logged trials, which no budget here makes up for. What counts is success by draws,
from reset states that neither training nor ``pixel_comparison`` uses.
"""

from __future__ import annotations

from comparison import PAPER, Row
import numpy as np
import pixel_comparison
from scipy.stats import qmc
import state_comparison

TRIALS = 2

_COMMON = {"min-alpha": (0.001, 0.01), "learning-rate-e": (3e-4, 1e-3)}
_PARAMETRIC = {"epsilon": (0.5, 3.0), "policy-max-std": (0.1, 1.0)}

SPACES = {
  "ap_npql": _COMMON | {"epsilon": (0.5, 3.0), "max-std": (0.04, 0.1)},
  "ap_mpo": _COMMON | _PARAMETRIC,
  # Smaller limits drive alpha to 1,000 at the start (experiments/log.md, sac3).
  "ap_sac": _COMMON | _PARAMETRIC | {"epsilon": (10.0, 50.0)},
  "sac": _COMMON | {"epsilon": (7.0, 12.0), "policy-initial-std": (0.05, 0.5)},
}
"""Ranges of the settings of ``agent`` by row, on a logarithmic scale."""


def trials(row: str) -> dict[str, Row]:
  """Returns the settings of a row's runs."""
  found, space = state_comparison.ROWS[row], SPACES[row]
  low, high = np.log(list(space.values())).T
  cube = qmc.LatinHypercube(len(space), rng=PAPER.index(row)).random(TRIALS)
  rows = {f"{row}_0": found}
  for trial, point in enumerate(np.exp(low + cube * (high - low)), start=1):
    flags = (f"--agent.{k} {x:.2g}" for k, x in zip(space, point, strict=True))
    rows[f"{row}_{trial}"] = Row(found.algorithm, " ".join([found.flags, *flags]))
  return rows


ROWS = {name: trial for row in PAPER for name, trial in trials(row).items()}

COMPARISON = pixel_comparison.variant(
  __file__,
  ROWS,
  play="--episodes 512 --bank-seed 2",
  tasks=("push_plate",),
  seeds=(0,),
)

if __name__ == "__main__":
  COMPARISON.main(__doc__)
