"""Tables and plots of docs/performance.md.

  python -m benchmarks.page.performance                    # from benchmarks/results
  python -m benchmarks.page.performance --measure          # measures all; takes hours
  python -m benchmarks.page.performance --measure render   # measures this one

A block of the document lies between two marks. Its tables are made from the stored
report of that name. Blocks whose report is missing stay as they are.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import subprocess
import sys

from benchmarks.common import store, tables
from benchmarks.page import plots, reports
from benchmarks.page.answer import NEEDED, answer

DOC = store.ROOT / "docs" / "performance.md"
BLOCKS = (
  *("fidelity", "render", "ray_layouts", "learner", "encoder_layouts", "env_steps"),
  *("end_to_end", "compile_time", "growth", "peers"),
)


def main() -> None:
  """Runs the command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--measure", nargs="*", choices=BLOCKS, help="these, or all")
  args = parser.parse_args()
  failed = []
  for name in [] if args.measure is None else args.measure or BLOCKS:
    command = [sys.executable, "-m", reports.module(name), "--store"]
    if subprocess.run(command, cwd=store.ROOT).returncode:
      failed.append(name)
  write()
  if failed:
    sys.exit(f"failed: {', '.join(failed)}")


def write(results: Path = store.RESULTS, doc: Path = DOC) -> None:
  """Puts every stored report into the document, and draws the plots next to it."""
  files = {path.stem: path for path in results.glob("*.json")}
  found = {k: json.loads(files[k].read_text()) for k in BLOCKS if k in files}
  for name, report in found.items():
    tables.put(name, reports.block(report), doc)
  if found.keys() >= set(NEEDED):
    tables.put("answer", answer(found), doc)
  if "gpu" in files:
    sections = json.loads(files["gpu"].read_text())["sections"].values()
    blocks = [reports.block(s["report"]) for s in sections if s["report"]["results"]]
    tables.put("gpu", "\n\n".join(blocks), doc)
  images = doc.parent / "images"
  images.mkdir(exist_ok=True)
  if "growth" in found:
    plots.growth(found["growth"], images / "growth.png")
  if "env_steps" in found and "end_to_end" in found:
    plots.rates(found["env_steps"], found["end_to_end"], images / "rates.png")


if __name__ == "__main__":
  main()
