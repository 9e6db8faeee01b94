"""A training run that is killed, stopped, damaged, poisoned and starved repeatedly.

  python -m benchmarks.reliability.soak --minutes 60      # two cores, no GPU needed

Two runs of one seed train side by side. One is undisturbed, and its memory is measured.
The other meets a fault every few seconds and is resumed. At the end a third run trains
straight to the step of the disturbed one. All their arrays must be the same bits, and
the metrics of all three the same numbers. Non-finite worlds and rewards are
put into checkpoints of copies of the disturbed run. Writes results/soak.json and
results/soak.log.
"""

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
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from apnpql_jax import errors, runtime, testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import (
  checkpoint_reader,
  checkpoint_record,
  run_folder,
  segments,
)
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume
from apnpql_jax.training.state import example_state
from benchmarks.common import store

INTERVAL = 512  # environment steps between two checkpoints

OPTIONS = f"--checkpoint-every {INTERVAL} --eval-every {64 * INTERVAL}".split()
OPTIONS += "--replay.capacity 4096 --replay.expert-steps 512".split()
ENDLESS = ["--total-steps", "2000000000"]
PATIENCE_S = 600
Process = subprocess.Popen[bytes]
Row = dict[str, Any]


class Trial:
  """A run in a folder of its own, and the faults it can meet."""

  def __init__(self, folder: Path, rng: random.Random):
    """Makes the folder; nothing is started yet."""
    folder.mkdir()
    self.run, self._rng = folder / "run", rng
    self._output = folder / "output"

  def start(self, run: Path, *args: str) -> Process:
    """Trains in a new process, whose output replaces that of the previous one."""
    self._output.write_text("")
    return testing.start(run, *OPTIONS, *(args or ENDLESS), log=self._output)

  def disturb(self, fault: str) -> Row:
    """Trains for some seconds, causes a fault, and returns its consequences."""
    run, target = self.run, self.run
    before = checkpoint_reader.latest_step(run) or 0
    if fault.startswith("poisoned"):
      target = run.with_name("poisoned")
      shutil.copytree(run, target)
      poison(target, rewards=fault.endswith("rewards"))
    process = self.start(target)
    self.wait(process)
    code = self._end(process, fault)
    row = {"fault": fault, "exit": code, "from": before, "to": reached(target)}
    if target is run:
      row["lost"] = row["to"] - (checkpoint_reader.latest_step(run) or 0)
      if fault == "bit flip" and len(checkpoint_reader.all_steps(run)) > 1:
        row["file"] = flip_a_bit(run, self._rng)
    else:
      faults = [r for r in testing.rows(target) if r["step"] > before]
      for name in ("faults/worlds", "faults/updates"):
        row[name] = sum(r.get(name) or 0 for r in faults)
      if dumps := list(target.glob("faults/*.npz")):
        row["repeated"] = repeat(dumps[0])
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

  def output(self) -> str:
    """Returns the last output of the newest process."""
    return self._output.read_text(errors="replace")[-2000:]

  def wait(self, process: Process) -> None:
    """Waits until the newest process has completed an iteration or ended."""
    self._until(lambda: "%)" in self._output.read_text(errors="replace"), process)

  def _until(self, happens: Callable[[], bool], process: Process) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not happens() and process.poll() is None:
      if time.monotonic() > deadline:
        raise TimeoutError(self.output())
      time.sleep(0.005)


def ended(process: Process, patience_s: float = PATIENCE_S) -> int | None:
  """Returns the exit code of a process; None if it hangs, after killing it."""
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
"""Fault -> exit code that it must cause."""


def as_expected(row: Row) -> bool:
  """Returns whether a fault had exactly the effects of docs/reliability.md."""
  fault = row["fault"]
  if fault == "poisoned world" and row["faults/worlds"] != 1:
    return False
  if fault == "poisoned rewards" and "reward_t" not in row.get("repeated", ""):
    return False
  # A checkpoint in writing is lost together with the steps trained meanwhile.
  return row["exit"] == EXPECTED[fault] and row.get("lost", 0) <= 2 * INTERVAL


def reached(run: Path) -> int:
  """Returns the environment steps of the last whole row of the metrics."""
  rows = testing.rows(run)
  return rows[-1]["step"] if rows else 0


def resident_mib(process: Process) -> float:
  """Returns the resident memory of a process."""
  pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
  return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def growth(samples: list[tuple[float, float]]) -> dict[str, Any]:
  """Summarizes samples of (minutes, MiB); the slope leaves out the first fifth."""
  minutes, mib = np.array(samples).T
  late = minutes >= 0.2 * minutes[-1]
  slope = 60 * np.polyfit(minutes[late], mib[late], 1)[0]
  return {"minutes_mib": np.round(samples, 1).tolist(), "slope_mib_per_h": slope}


def same_bits(trials: list[Trial], total: int, patience_s: float) -> bool:
  """Trains all runs to the step ``total``; returns whether their arrays are equal."""
  processes = [trial.start(trial.run, "--total-steps", str(total)) for trial in trials]
  if [ended(process, patience_s) for process in processes] != [0] * len(trials):
    print("\n".join(trial.output() for trial in trials), file=sys.stderr)
    return False
  first, *others = (testing.saved_bytes(trial.run, total) for trial in trials)
  return all(bits == first for bits in others)


def same_metrics(*runs: Path) -> bool:
  """Returns whether all runs have each iteration once and the same losses."""
  losses = []
  for run in runs:
    rows = [row for row in testing.rows(run) if "loss/q" in row]
    losses.append([row["loss/q"] for row in rows])
    whole = [testing.STEPS * number for number in range(1, len(rows) + 1)]
    if [row["step"] for row in rows] != whole:
      return False
  return all(len(set(values)) == 1 for values in zip(*losses, strict=False))


def main() -> int:
  """Runs the soak; returns 0 if every promise was kept."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--minutes", type=float, default=60.0)
  parser.add_argument("--seed", type=int, default=0)
  args = parser.parse_args()
  runtime.configure()
  with tempfile.TemporaryDirectory() as name:
    result, events = soak(Path(name), args.minutes, random.Random(args.seed))
  store.store("soak", result)
  lines = [json.dumps(event) + "\n" for event in events]
  store.RESULTS.joinpath("soak.log").write_text("".join(lines))
  print(json.dumps(result))
  return 0 if result["as_promised"] else 1


def soak(folder: Path, minutes: float, rng: random.Random) -> tuple[Row, list[Row]]:
  """Runs everything; returns a summary and the events in their order."""
  names = ("alone", "disturbed", "straight")
  alone, disturbed, straight = (Trial(folder / name, rng) for name in names)
  events: list[Row] = []
  process = alone.start(alone.run)
  alone.wait(process)  # The others take its programs from the cache.
  began, memory = time.monotonic(), []
  try:
    while (passed := (time.monotonic() - began) / 60) < minutes:
      event = disturbed.disturb(list(EXPECTED)[len(events) % len(EXPECTED)])
      event = {"minute": round(passed, 1), "as_promised": as_expected(event)} | event
      event |= {} if event["as_promised"] else {"output": disturbed.output()}
      events.append(event)
      memory.append((passed, resident_mib(process)))
      print(json.dumps(event), flush=True)
  finally:
    process.terminate()
  stopped = ended(process) == EXPECTED["SIGTERM"]
  total = reached(disturbed.run) + testing.STEPS
  # The disturbed run took the whole soak to come here.
  patience_s = PATIENCE_S + 60 * minutes
  result = {
    "minutes": round(passed, 1),
    "cores": runtime.cores(),
    "env_steps": {"alone": reached(alone.run), "disturbed": total},
    "faults": collections.Counter(event["fault"] for event in events),
    "most_steps_lost": max((event.get("lost", 0) for event in events), default=0),
    "checkpoint_every": INTERVAL,
    "memory": growth(memory),
    "same_bits": same_bits([disturbed, straight], total, patience_s),
    "metrics_consistent": same_metrics(straight.run, disturbed.run, alone.run),
  }
  kept = stopped and result["same_bits"] and result["metrics_consistent"]
  kept = kept and all(event["as_promised"] for event in events)
  return result | {"as_promised": kept}, events


def poison(run: Path, *, rewards: bool) -> None:
  """Saves a run's only checkpoint with NaN in all rewards, or in a world's velocity."""
  config = run_folder.load_run_config(run)
  env, agent = make_env(config.env), make_agent(config.agent)
  example = example_state(config, env, agent)
  state = resume.restore_run(config, run, example, lambda line: None).state
  if rewards:
    for name in ("replay", "expert_replay"):
      slots = getattr(state, name).slots
      timestep = slots.timestep.replace(reward=slots.timestep.reward * jnp.nan)
      ring = getattr(state, name).replace(slots=slots.replace(timestep=timestep))
      state = state.replace(**{name: ring})
  else:
    physics = state.env.physics
    physics = physics.replace(qvel=physics.qvel.at[1, 0].set(jnp.nan))
    state = state.replace(env=state.env.replace(physics=physics))
  shutil.rmtree(run / "checkpoints")
  with CheckpointWriter(run, config, keep=1) as writer:
    writer.save(int(state.env_steps), resume.to_items(state, whole=True))


def flip_a_bit(run: Path, rng: random.Random) -> str:
  """Flips a bit in the largest file that only the newest checkpoint needs; names it."""
  *older, newest = checkpoint_record.read_all(run).items()
  shared = {segment.number for _, record in older for segment in record.segments}
  folders = [run / "checkpoints" / str(newest[0])]
  for segment in newest[1].segments:
    if segment.number not in shared:
      folders.append(segments.folder(run) / str(segment.number))
  files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
  file = max(files, key=lambda path: path.stat().st_size)
  data = bytearray(file.read_bytes())
  data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
  file.write_bytes(data)
  return str(file.relative_to(run.absolute()))


def repeat(dump: Path) -> str:
  """Returns the output of ``apnpql repeat`` for a dumped update."""
  command = [sys.executable, "-m", "apnpql_jax", "repeat", str(dump)]
  env = os.environ | {"PYTHONPATH": str(testing.ROOT)}
  done = subprocess.run(command, cwd=dump.parent, env=env, capture_output=True)
  return done.stdout.decode()


if __name__ == "__main__":
  sys.exit(main())
