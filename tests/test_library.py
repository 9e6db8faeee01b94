"""The script of the page "Use it as a library" runs as it stands."""

from __future__ import annotations

import ast
import os
from pathlib import Path
import re
import subprocess
import sys

from apnpql_jax import testing


def test_the_script_of_the_library_page_runs(tmp_path: Path):
  page = (testing.ROOT / "docs" / "library.md").read_text()
  (script,) = re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S)
  (tmp_path / "script.py").write_text(script)
  done = subprocess.run(
    [sys.executable, "script.py"],
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
