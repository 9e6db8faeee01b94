"""A run under fire: killed, stopped, damaged and starved of disk, again and again.

Trains a small run from state observations for as long as asked, does something to it
every now and then, resumes it each time, and at last trains the same run undisturbed
and compares the two, bit for bit. One JSON object per fault goes to standard output.

  python benchmarks/soak.py --minutes 60 --run runs/soak
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import os
from pathlib import Path
import random
import resource
import signal
import subprocess
import sys
import time
from typing import Any

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)

import jax
import numpy as np
import orbax.checkpoint as ocp

from apnpql_jax import checkpoint

SETTINGS = (
  "--obs state --env.worlds 8 --env.bank-rows 256 --agent.hidden 32 32 "
  "--agent.feature-dim 32 --agent.target-samples 16 --agent.policy-samples 16 "
  "--replay.capacity 4096 --replay.expert-steps 512 --replay.expert-share 0.5 "
  "--replay.batch-size 32 --rollout-length 4 --updates-per-iteration 4 --no-video "
  "--eval-every 1000000000 --eval-episodes 4 --checkpoint-every 512"
).split()
FOR_EVER = "2000000000"


def start(run: Path, total: str, *, file_limit: int | None = None) -> subprocess.Popen:
  """Trains, or goes on; a file beyond ``file_limit`` bytes meets a full disk."""
  command = [sys.executable, "-m", "apnpql_jax", "train", "--total-steps", total]
  if (run / "config.json").exists():
    command += ["--resume", str(run)]
  else:
    command += ["push_plate", "--run", str(run), *SETTINGS]
  limit = resource.RLIM_INFINITY if file_limit is None else file_limit
  with run.with_suffix(".log").open("ab") as log:
    return subprocess.Popen(
      command,
      stdout=log,
      stderr=log,
      preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )


def reached(run: Path) -> int:
  """Environment steps of the last whole row of the metrics."""
  path = run / "metrics.jsonl"
  lines = path.read_text().splitlines(keepends=True) if path.exists() else []
  whole = [line for line in lines if line.endswith("\n")]
  return json.loads(whole[-1])["step"] if whole else 0


def resident_mib(process: subprocess.Popen) -> float:
  """Memory of a process that is still there."""
  status = Path(f"/proc/{process.pid}/status").read_text()
  fields = dict(line.split(":", 1) for line in status.splitlines())
  return int(fields.get("VmRSS", "0 kB").split()[0]) / 1024


def train_a_while(process: subprocess.Popen, run: Path, seconds: float) -> list[float]:
  """Waits for the first new row, then ``seconds``; memory once a second meanwhile."""
  metrics, memory = run / "metrics.jsonl", []
  begun = metrics.stat().st_mtime if metrics.exists() else 0.0
  until = None
  while process.poll() is None and (until is None or time.monotonic() < until):
    moved = metrics.exists() and metrics.stat().st_mtime > begun
    if until is None and moved and reached(run) > (checkpoint.latest_step(run) or 0):
      until = time.monotonic() + seconds
    if until is not None:
      memory.append(resident_mib(process))
    time.sleep(1.0)
  return memory


def flip_a_bit(run: Path, rng: random.Random) -> str:
  """In the replay of the newest checkpoint; returns the file."""
  folder = run / "checkpoints" / str(checkpoint.latest_step(run)) / "replay"
  files = [p for p in folder.rglob("*") if p.is_file() and p.stat().st_size]
  file = max(files, key=lambda p: p.stat().st_size)
  data = bytearray(file.read_bytes())
  data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
  file.write_bytes(data)
  return str(file.relative_to(run))


def disturb(run: Path, fault: str, rng: random.Random) -> dict[str, Any]:
  """One stretch of training and what ends it."""
  before = checkpoint.latest_step(run) or 0
  limit = None
  if fault == "disk full":  # Some rows fit, a checkpoint does not.
    limit = (run / "metrics.jsonl").stat().st_size + (32 << 10)
  process = start(run, FOR_EVER, file_limit=limit)
  memory = train_a_while(process, run, rng.uniform(5, 60))
  stop: dict[str, Callable[[], None]] = {
    "SIGTERM": process.terminate,
    "SIGINT": lambda: process.send_signal(signal.SIGINT),
  }
  stop.get(fault, process.kill)()
  code = process.wait(600)
  step, saved = reached(run), checkpoint.latest_step(run) or 0
  row = {"fault": fault, "exit": code, "from": before, "to": step, "saved": saved}
  row["lost"] = step - saved
  if fault == "bit flip" and len(checkpoint.all_steps(run)) > 1:
    row["file"] = flip_a_bit(run, rng)
  if memory:
    row["mib"] = [round(memory[0]), round(memory[-1])]
  return row


def same_bits(a: Path, b: Path, step: int) -> bool:
  """Whether two runs have the same arrays at a step, read by Orbax alone."""

  def arrays(run: Path) -> list[bytes]:
    folders = [
      run / "checkpoints" / str(step) / i for i in ("learner", "rest", "replay")
    ]
    with ocp.StandardCheckpointer() as reader:
      trees = [reader.restore(folder.absolute()) for folder in folders]
    return [np.asarray(x).tobytes() for x in jax.tree.leaves(trees)]

  return arrays(a) == arrays(b)


def main() -> int:
  """Runs the soak; 0 if nothing was lost beyond what is promised."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("--minutes", type=float, default=60.0)
  parser.add_argument("--run", type=Path, required=True)
  parser.add_argument("--seed", type=int, default=0)
  args = parser.parse_args()
  rng, run = random.Random(args.seed), args.run.absolute()
  os.makedirs(run.parent, exist_ok=True)
  began = time.monotonic()
  faults = ["SIGKILL", "SIGTERM", "SIGKILL", "bit flip", "SIGINT", "disk full"]
  count = 0
  while time.monotonic() - began < 60 * args.minutes:
    row = disturb(run, faults[count % len(faults)], rng)
    minutes = (time.monotonic() - began) / 60
    print(json.dumps({"minutes": round(minutes, 1), **row}), flush=True)
    count += 1
  total = reached(run) + 512
  total -= total % 32
  straight = run.with_name(run.name + "-straight")
  codes = [start(folder, str(total)).wait() for folder in (run, straight)]
  same = codes == [0, 0] and same_bits(run, straight, total)
  print(json.dumps({"faults": count, "env_steps": total, "same_bits": same}))
  return 0 if same else 1


if __name__ == "__main__":
  sys.exit(main())
