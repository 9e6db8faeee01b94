"""Transfer of runs to other physics, renderers and looks: a table.

  python experiments/results/transfer_table.py runs/mine runs/other
  python experiments/results/transfer_table.py runs/mine --cells bullet/tiny/plain \
      bullet/tiny/plain/60/admittance
  python experiments/results/transfer_table.py expert:stack_box

A cell is physics/renderer/looks and, with Bullet, the latency in ms and "admittance".
Every cell of every run is played by `apnpql transfer` in a process of its own, and its
result stored as <folder>/<run>-<cell>.json. The same command again plays only what is
missing. Then writes table.md from all files of the folder. Runs are distinguished by
the names of their folders.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path
import subprocess
import sys
from typing import Any

from apnpql_jax.atomic import replacing
from apnpql_jax.reports.tables import markdown

OUT = Path(__file__).resolve().with_suffix("")

EXPERT = "expert:"

CELLS = [
  "/".join(cell)
  for cell in itertools.product(
    ("native", "bullet"), ("rays", "opengl", "tiny"), ("trained", "plain", "unseen")
  )
  if cell[1:] != ("rays", "unseen")
]
"""All cells, without MJX, which integrates the same equations as C MuJoCo."""

EXPERT_CELLS = ["native/rays/plain", "bullet/rays/plain"]
"""Cells of the expert, which sees no images."""

HEAD = "run task trained physics renderer looks latency admittance solved 95%"
"""Columns of the table; trained: in plain or randomized worlds."""


def options_of(run: str, cell: str) -> list[str]:
  """Returns the arguments of `apnpql transfer`."""
  physics, renderer, looks, *more = cell.split("/")
  who = [run]
  if run.startswith(EXPERT):
    who = ["expert", "--task", run.removeprefix(EXPERT)]
  options = ["--physics", physics, "--renderer", renderer, "--looks", looks]
  for word in more:
    options += ["--admittance"] if word == "admittance" else ["--latency-ms", word]
  return [*who, *options]


def path_of(out: Path, run: str, cell: str) -> Path:
  """Returns the file of a result."""
  name = run.replace(":", "-") if run.startswith(EXPERT) else Path(run).name
  return out / f"{name}-{cell.replace('/', '-')}.json"


def play(path: Path, run: str, cell: str, episodes: int, seed: int) -> None:
  """Plays a cell and stores its result.

  Raises:
    SystemExit: The command failed; it has told why.
  """
  count = ["--episodes", str(episodes), "--seed", str(seed), "--json"]
  command = [sys.executable, "-m", "apnpql_jax", "transfer", *options_of(run, cell)]
  done = subprocess.run([*command, *count], stdout=subprocess.PIPE, check=False)
  if done.returncode:
    sys.exit(done.returncode)
  found = json.loads(done.stdout)
  path.parent.mkdir(parents=True, exist_ok=True)
  with replacing(path) as part:
    part.write_text(json.dumps({"run": path_name(run), **found}, indent=1) + "\n")
  print(f"{path.stem}: {found['successes']} of {found['episodes']}", flush=True)


def path_name(run: str) -> str:
  """Returns the name of a run in the table."""
  return "expert" if run.startswith(EXPERT) else Path(run).name


def table(results: list[dict[str, Any]]) -> str:
  """Returns the results in Markdown, a row per cell."""
  rows = [list[str](HEAD.split())]
  for found in sorted(results, key=order):
    low, high = (100 * x for x in found["ci95"])
    trained = found.get("trained", "-")
    latency = f"{found['latency_ms']} ms" if "latency_ms" in found else "-"
    yields = {True: "on", False: "off"}.get(found.get("admittance"), "-")
    solved = f"{found['successes']} of {found['episodes']}"
    rows.append(
      [found["run"], found["task"], trained]
      + [found["physics"], found["renderer"], found["looks"], latency, yields]
      + [solved, f"{low:.1f} to {high:.1f} %"]
    )
  return markdown(rows) + "\n"


def order(found: dict[str, Any]) -> tuple[str, ...]:
  """Returns what rows are sorted by."""
  names = "task run physics renderer looks latency_ms admittance".split()
  return tuple(str(found.get(name, "")) for name in names)


def main() -> None:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("runs", nargs="*", help="run folders, or expert:TASK")
  parser.add_argument("--cells", nargs="+", help="default: all that there are")
  parser.add_argument("--episodes", type=int, default=200)
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--out", type=Path, default=OUT, help="folder of the results")
  args = parser.parse_args()
  for run in args.runs:
    default = EXPERT_CELLS if run.startswith(EXPERT) else CELLS
    for cell in args.cells or default:
      path = path_of(args.out, run, cell)
      if not path.exists():
        play(path, run, cell, args.episodes, args.seed)
      elif (was := json.loads(path.read_text())["episodes"]) != args.episodes:
        sys.exit(f"{path} has {was} episodes; remove it to play {args.episodes}")
  found = [json.loads(path.read_text()) for path in sorted(args.out.glob("*.json"))]
  if found:
    (args.out / "table.md").write_text(table(found))
    print(table(found))


if __name__ == "__main__":
  main()
