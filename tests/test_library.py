"""The script of the page "Use it as a library" runs as it stands."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import subprocess
import sys

from apnpql_jax import testing

SCRIPT = testing.ROOT / "docs" / "examples" / "library.py"


def test_the_example_of_the_library_page_runs(tmp_path: Path):
  done = subprocess.run(
    [sys.executable, str(SCRIPT)],
    cwd=tmp_path,
    env=os.environ | {"XLA_FLAGS": testing.XLA_FLAGS, "PYTHONPATH": str(testing.ROOT)},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr[-2000:]
  rewards, trained, evaluated = done.stdout.splitlines()
  assert rewards.startswith("rewards: [")
  assert ast.literal_eval(trained)["env_steps"] == 32
  assert ast.literal_eval(evaluated)["episodes"] == 4
  assert (tmp_path / "runs" / "library" / "metrics.jsonl").exists()
