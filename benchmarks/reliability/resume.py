"""Difference between a resumed and an uninterrupted run on this device.

  python -m benchmarks.reliability.resume --backend mjx --obs pixels  # under 10 minutes

One process trains without a break. A second one stops halfway, and a third one resumes
from there. The runs are tiny, but compiled as any run is. All arrays of the two final
training states are compared. On a CPU they must be the same bits.
"""

import argparse
import json
from pathlib import Path
import sys
import tempfile
from typing import Any

import numpy as np

from apnpql_jax import runtime, testing
from apnpql_jax.config.checks import BACKENDS, OBSERVATIONS

Arrays = dict[str, np.ndarray]


def main() -> int:
  """Prints the report; returns 0 if all arrays are the same bits."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--algorithm", default=testing.TINY.agent.algorithm)
  parser.add_argument("--backend", default="auto", choices=BACKENDS)
  parser.add_argument("--obs", default="pixels", choices=OBSERVATIONS)
  parser.add_argument("--iterations", type=int, default=16, help="of each half")
  args = parser.parse_args()
  runtime.configure()
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
  """Trains to the end in a new process; raises its output if it fails."""
  output = run.parent / "output"
  if testing.start(run, *args, log=output, xla_flags="").wait():
    raise RuntimeError(output.read_text()[-2000:])


def compare(a: Arrays, b: Arrays) -> dict[str, Any]:
  """Counts the arrays of equal bits and measures the largest relative difference.

  Raises:
    ValueError: The states have different arrays.
  """
  if a.keys() != b.keys():
    raise ValueError(f"only one state has {sorted(a.keys() ^ b.keys())}")
  differ = {}
  for name in a:
    if a[name].tobytes() != b[name].tobytes():
      x, y = a[name].astype(float), b[name].astype(float)
      most = max(np.abs(x).max(), np.finfo(float).tiny)
      differ[name] = float(np.abs(x - y).max() / most)
  largest = dict(sorted(differ.items(), key=lambda pair: -pair[1])[:10])
  return {"arrays": len(a), "same_bits": len(a) - len(differ), "differ": largest}


if __name__ == "__main__":
  sys.exit(main())
