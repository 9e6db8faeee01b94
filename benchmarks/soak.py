"""A run under fire: killed, stopped, damaged, poisoned and starved, again and again.

  python benchmarks/soak.py --minutes 60      # two cores; any machine without a GPU

Two runs of one seed train side by side. One is left alone, and its memory is measured;
the other meets a fault every few seconds and is resumed. At the end a third one trains
straight to where the disturbed one is: all their arrays must be the same bits, and the
metrics of all three the same figures. Worlds and rewards that are not finite are put
into checkpoints of copies of the disturbed run. Writes results/soak.json and
results/soak.log beside this file.
"""

from __future__ import annotations

import argparse
import collections
from collections.abc import Callable
import json
import os
from pathlib import Path
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

import damage
import numpy as np

from apnpql_jax import errors, testing
from apnpql_jax.runs import checkpoint_reader

RESULTS = Path(__file__).resolve().parent / "results"
INTERVAL = 512
"""Environment steps between two checkpoints."""

OPTIONS = (
  f"--replay.capacity 4096 --replay.expert-steps 512 --checkpoint-every {INTERVAL} "
  f"--eval-every {64 * INTERVAL}"
)
FOR_EVER = ["--total-steps", "2000000000"]
PATIENCE_S = 600
Process = subprocess.Popen[bytes]


class Trial:
  """A run in a folder of its own, and what one may do to it."""

  def __init__(self, folder: Path, rng: random.Random):
    folder.mkdir()
    self.run, self._rng = folder / "run", rng
    self._said = folder / "said"

  def start(self, run: Path, *args: str) -> Process:
    """A process that trains; its output replaces that of the one before."""
    self._said.write_text("")
    return testing.start(run, *OPTIONS.split(), *(args or FOR_EVER), said=self._said)

  def disturb(self, fault: str) -> dict[str, Any]:
    """Trains for some seconds, does something, and tells what came of it."""
    run, target = self.run, self.run
    before = checkpoint_reader.latest_step(run) or 0
    if fault.startswith("poisoned"):
      target = run.with_name("poisoned")
      shutil.copytree(run, target)
      damage.poison(target, rewards=fault.endswith("rewards"))
    process = self.start(target)
    self.wait(process)
    code = self._end(process, fault)
    row = {"fault": fault, "exit": code, "from": before, "to": reached(target)}
    if target is run:
      row["lost"] = row["to"] - (checkpoint_reader.latest_step(run) or 0)
      if fault == "bit flip" and len(checkpoint_reader.all_steps(run)) > 1:
        row["file"] = damage.flip_a_bit(run, self._rng)
    else:
      faults = [r for r in testing.rows(target) if r["step"] > before]
      for name in ("faults/worlds", "faults/updates"):
        row[name] = sum(r.get(name) or 0 for r in faults)
      if dumps := list(target.glob("faults/*.npz")):
        row["repeated"] = _repeat(dumps[0])
      shutil.rmtree(target)
    return row

  def _end(self, process: Process, fault: str) -> int | None:
    pause = self._rng.uniform(0.0, 8.0)
    if fault == "kill in a save":
      self._until(lambda: any((self.run / "checkpoints").glob("*tmp*")), process)
      process.kill()
    elif fault == "disk full":
      time.sleep(pause)
      resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (16 << 10, 16 << 10))
    elif fault != "poisoned rewards":  # That stops by itself.
      time.sleep(pause)
      polite = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM}
      polite["poisoned world"] = signal.SIGTERM
      process.send_signal(polite.get(fault, signal.SIGKILL))
    return ended(process)

  def said(self) -> str:
    """The end of what the last process said."""
    return self._said.read_text(errors="replace")[-2000:]

  def wait(self, process: Process) -> None:
    """Until the process just started has done an iteration, or has ended."""
    self._until(lambda: "%)" in self._said.read_text(errors="replace"), process)

  def _until(self, happens: Callable[[], bool], process: Process) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not happens() and process.poll() is None:
      if time.monotonic() > deadline:
        raise TimeoutError(self.said())
      time.sleep(0.005)


def ended(process: Process, patience_s: float = PATIENCE_S) -> int | None:
  """Exit code of a process that is to end; None if it hangs, and is killed."""
  try:
    return process.wait(patience_s)
  except subprocess.TimeoutExpired:
    process.kill()
    process.wait()
    return None


EXPECTED = {
  "kill": -signal.SIGKILL,
  "SIGTERM": 128 + signal.SIGTERM,
  "poisoned world": 128 + signal.SIGTERM,
  "poisoned rewards": errors.FAILED,
  "kill in a save": -signal.SIGKILL,
  "disk full": errors.FAILED,
  "bit flip": -signal.SIGKILL,
  "SIGINT": 128 + signal.SIGINT,
}
"""Fault -> exit code that it must have."""


def as_expected(row: dict[str, Any]) -> bool:
  """Whether a fault did what ``docs/reliability.md`` says, and no more."""
  fault = row["fault"]
  if fault == "poisoned world" and row["faults/worlds"] != 1:
    return False
  if fault == "poisoned rewards" and "reward_t" not in row.get("repeated", ""):
    return False
  # What is trained while a checkpoint is being written is lost with it.
  return row["exit"] == EXPECTED[fault] and row.get("lost", 0) <= 2 * INTERVAL


def reached(run: Path) -> int:
  """Environment steps of the last whole row of the metrics."""
  rows = testing.rows(run)
  return rows[-1]["step"] if rows else 0


class Memory:
  """Resident memory of a process, once a second, until it ends."""

  def __init__(self, process: Process):
    self.samples: list[tuple[float, float]] = []  # s, MiB
    self._process = process
    self._thread = threading.Thread(target=self._watch)
    self._thread.start()

  def _watch(self) -> None:
    began = time.monotonic()
    while self._process.poll() is None:
      pages = int(Path(f"/proc/{self._process.pid}/statm").read_text().split()[1])
      mib = pages * os.sysconf("SC_PAGE_SIZE") / 2**20
      self.samples.append((time.monotonic() - began, mib))
      time.sleep(1.0)

  def summary(self) -> dict[str, Any]:
    """MiB once a minute, and their slope after the first fifth of the time."""
    self._thread.join()
    seconds, mib = np.array(self.samples[:-1]).T
    late = seconds > 0.2 * seconds[-1]
    slope = np.polyfit(seconds[late] / 3600, mib[late], 1)[0]
    minutes = [round(float(x)) for x in mib[::60]]
    return {"minutes_mib": minutes, "slope_mib_per_h": round(float(slope), 1)}


def same_bits(trials: list[Trial], total: int, patience_s: float) -> bool:
  """Whether all runs, trained to the step ``total``, hold the same arrays there."""
  processes = [trial.start(trial.run, "--total-steps", str(total)) for trial in trials]
  if [ended(process, patience_s) for process in processes] != [0] * len(trials):
    print("\n".join(trial.said() for trial in trials), file=sys.stderr)
    return False
  first, *others = (testing.saved_bytes(trial.run, total) for trial in trials)
  return all(bits == first for bits in others)


def same_metrics(*runs: Path) -> bool:
  """Whether each iteration stands once in the metrics of each run, with one loss.

  Runs may differ in length; they are compared as far as the shortest goes.
  """
  losses = [
    [(row["step"], row["loss/q"]) for row in testing.rows(run) if "loss/q" in row]
    for run in runs
  ]
  whole = all(
    step == number * testing.STEPS
    for run in losses
    for number, (step, _) in enumerate(run, start=1)
  )
  return whole and all(len(set(rows)) == 1 for rows in zip(*losses, strict=False))


def main() -> int:
  """Runs the soak; 0 if everything came as promised."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("--minutes", type=float, default=60.0)
  parser.add_argument("--seed", type=int, default=0)
  args = parser.parse_args()
  with tempfile.TemporaryDirectory() as name:
    result, events = soak(Path(name), args.minutes, random.Random(args.seed))
  RESULTS.joinpath("soak.json").write_text(json.dumps(result, indent=2) + "\n")
  lines = [json.dumps(event) + "\n" for event in events]
  RESULTS.joinpath("soak.log").write_text("".join(lines))
  print(json.dumps(result))
  return 0 if result["as_promised"] else 1


def soak(
  folder: Path, minutes: float, rng: random.Random
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
  """All runs to their end: a summary, and what happened in its order."""
  names = ("alone", "disturbed", "straight")
  alone, disturbed, straight = (Trial(folder / name, rng) for name in names)
  events: list[dict[str, Any]] = []
  process = alone.start(alone.run)
  alone.wait(process)  # What it compiles, the others take from the cache.
  memory, began = Memory(process), time.monotonic()
  try:
    while (passed := (time.monotonic() - began) / 60) < minutes:
      event = disturbed.disturb(list(EXPECTED)[len(events) % len(EXPECTED)])
      event = {"minute": round(passed, 1), "as_promised": as_expected(event)} | event
      event |= {} if event["as_promised"] else {"said": disturbed.said()}
      events.append(event)
      print(json.dumps(event), flush=True)
  finally:
    process.terminate()
  stopped = ended(process) == EXPECTED["SIGTERM"]
  total = reached(disturbed.run) + testing.STEPS
  # The disturbed run has taken the time of the soak to come here.
  patience_s = PATIENCE_S + 60 * minutes
  result = {
    "minutes": round(passed, 1),
    "cores": len(os.sched_getaffinity(0)),
    "env_steps": {"alone": reached(alone.run), "disturbed": total},
    "faults": collections.Counter(event["fault"] for event in events),
    "most_steps_lost": max((event.get("lost", 0) for event in events), default=0),
    "checkpoint_every": INTERVAL,
    "memory": memory.summary(),
    "same_bits": same_bits([disturbed, straight], total, patience_s),
    "metrics_consistent": same_metrics(straight.run, disturbed.run, alone.run),
  }
  kept = stopped and result["same_bits"] and result["metrics_consistent"]
  kept = kept and all(event["as_promised"] for event in events)
  return result | {"as_promised": kept}, events


def _repeat(dump: Path) -> str:
  """What ``apnpql repeat`` says of a dumped update."""
  command = [sys.executable, "-m", "apnpql_jax", "repeat", str(dump)]
  env = os.environ | {"PYTHONPATH": str(testing.ROOT)}
  done = subprocess.run(command, cwd=dump.parent, env=env, capture_output=True)
  return done.stdout.decode()


if __name__ == "__main__":
  sys.exit(main())
