"""How close a resumed run comes to the run it would have been, on this device.

  python benchmarks/resume.py --backend mjx --obs pixels      # under 10 minutes

One process trains straight, a second one half of the way, a third one goes on from
there; all are tiny, but compiled as any run is. All arrays of the two training states
are compared. On a CPU they must be the same bits; on a GPU this tells what differs.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import sys
import tempfile
from typing import Any

import numpy as np

from apnpql_jax import testing
from apnpql_jax.config.checks import BACKENDS, OBSERVATIONS

Arrays = dict[str, np.ndarray]


def main() -> int:
  """Prints the report; 0 if all arrays are the same bits."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("--algorithm", default=testing.TINY.agent.algorithm)
  parser.add_argument("--backend", default="auto", choices=BACKENDS)
  parser.add_argument("--obs", default="pixels", choices=OBSERVATIONS)
  parser.add_argument("--iterations", type=int, default=16, help="of each half")
  args = parser.parse_args()
  options = ["--algorithm", args.algorithm, "--backend", args.backend]
  options += ["--obs", args.obs]
  half = args.iterations * testing.STEPS
  with tempfile.TemporaryDirectory() as name:
    straight, halves = Path(name) / "straight", Path(name) / "halves"
    for run, total in ((straight, 2 * half), (halves, half), (halves, 2 * half)):
      train(run, *options, "--total-steps", str(total))
    device = json.loads((straight / "versions.json").read_text())["device"]
    states = [testing.saved_arrays(run, 2 * half) for run in (straight, halves)]
  result = {**vars(args), "device": device, **compare(*states)}
  print(json.dumps(result, indent=2))
  return 0 if result["arrays"] == result["same_bits"] else 1


def train(run: Path, *args: str) -> None:
  """A process that trains to its end.

  Raises:
    RuntimeError: it did not; with the end of what it said.
  """
  said = run.parent / "said"
  if testing.start(run, *args, said=said, xla_flags="").wait():
    raise RuntimeError(said.read_text()[-2000:])


def compare(a: Arrays, b: Arrays) -> dict[str, Any]:
  """How many arrays are the same bits, and by how much the others differ.

  A difference is the largest one in an array, as a share of the array's largest number.
  """
  if a.keys() != b.keys():
    raise ValueError(f"only one state has {sorted(a.keys() ^ b.keys())}")
  others = [name for name in a if a[name].tobytes() != b[name].tobytes()]
  differ = {
    name: _share(a[name].astype(float), b[name].astype(float)) for name in others
  }
  most = sorted(differ.items(), key=lambda pair: -pair[1])
  return {
    "arrays": len(a),
    "same_bits": len(a) - len(differ),
    "differ": dict(most[:10]),
  }


def _share(a: np.ndarray, b: np.ndarray) -> float:
  return float(np.abs(a - b).max() / max(np.abs(a).max(), np.finfo(float).tiny))


if __name__ == "__main__":
  sys.exit(main())
