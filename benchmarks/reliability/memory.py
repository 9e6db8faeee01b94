"""Memory of a training with a large replay, and the time that its checkpoints take.

  python -m benchmarks.reliability.memory --store            # 2, 7 and 12 GB
  python -m benchmarks.reliability.memory --gigabytes 2

A run is prepared whose replay is full: the slots of the expert's episodes, images
included, fill it over and over. They are too far apart for the compression to find the
repetition, so files are as large as those of a training. A new process with an empty
compilation cache resumes the run and saves several checkpoints, and Linux counts its
memory. There is one update per iteration, so that steps pass quickly.
"""

import argparse
from collections.abc import Iterator
import dataclasses
import os
from pathlib import Path
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax

from apnpql_jax import testing
from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.data import replay
from apnpql_jax.envs.env import make_env
from apnpql_jax.runs import leaves, run_folder
from apnpql_jax.runs.checkpoint_writer import CheckpointWriter
from apnpql_jax.training import resume
from apnpql_jax.training.expert import collect_expert
from apnpql_jax.training.start import needed_memory
from apnpql_jax.training.state import example_state, initial_state
from benchmarks.common import command, settings, store

TASK = "push_plate"
CHECKPOINTS = 3
"""Checkpoints of the measured process; steady memory is what it has after the first."""

PATIENCE_S = 1800.0


def main() -> None:
  parser = command.parser(__doc__)
  parser.add_argument("--gigabytes", nargs="+", type=float, default=[2, 7, 12])
  args = command.parse(parser)
  command.publish("memory", args, measure_all(args), preset=TASK)


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Yields the figures of each size."""
  preset = settings.preset(TASK, quick=args.quick)
  preset = dataclasses.replace(preset, updates_per_iteration=1, video=False)
  for size in [1e-4] if args.quick else args.gigabytes:
    with tempfile.TemporaryDirectory() as name:
      run = Path(name) / "run"
      prepared = prepare(run, sized(preset, 1e9 * size))
      yield prepared | measure(run)


def sized(config: TrainConfig, size: float) -> TrainConfig:
  """Returns the preset with an agent replay of about ``size`` bytes."""
  env, agent = make_env(config.env), make_agent(config.agent)
  part = leaves.nbytes(example_state(config, env, agent).expert_replay)
  count = max(1, round(size / part))
  capacity = count * config.replay.expert_steps
  return settings.changed(config, "replay", capacity=capacity)


def prepare(run: Path, config: TrainConfig) -> dict[str, Any]:
  """Saves a run with a full replay; returns its size and the memory that it needs."""
  env, agent = make_env(config.env), make_agent(config.agent)
  example = example_state(config, env, agent)
  state = initial_state(config, env, agent, collect_expert)
  assert state.expert_replay is not None
  ring, chunk = state.replay, state.expert_replay.slots
  add = jax.jit(replay.add, donate_argnums=0)
  for _ in range(config.replay.capacity // config.replay.expert_steps):
    ring = add(ring, chunk)
  steps = config.replay.capacity
  state = state.replace(replay=ring, env_steps=state.env_steps + steps)
  run_folder.create(run, config)
  with CheckpointWriter(run, config, keep=1) as writer:
    rings = resume.to_rings(state, chunk=config.rollout_length)
    writer.save(steps, resume.to_items(state, whole=True), rings=rings)
    figures = writer.proceed(wait=True)
  slot = leaves.nbytes(example.replay) / config.replay.capacity
  return {
    "replay_gb": leaves.nbytes((example.replay, example.expert_replay)) / 1e9,
    "new_mib": slot * config.checkpoint_every / 2**20,
    "announced_gb": needed_memory(example) / 1e9,
    "whole_s": figures["checkpoint/wall_s"],
    "whole_mib": figures["checkpoint/mib"],
  }


def measure(run: Path) -> dict[str, Any]:
  """Returns memory and times of a process that resumes the run, until it is stopped."""
  config = run_folder.load_run_config(run)
  command = [sys.executable, "-m", "apnpql_jax", "train", "--resume", str(run)]
  command += ["--total-steps", "2000000000", "--eval-every", "2000000000"]
  output, cache = run.with_name("output"), run.with_name("cache")
  env = {"PYTHONPATH": str(store.ROOT), "JAX_COMPILATION_CACHE_DIR": str(cache)}
  with output.open("wb") as file:
    process = subprocess.Popen(command, env=os.environ | env, stdout=file, stderr=file)
  deadline, steady, saved = time.monotonic() + PATIENCE_S, [], []
  try:
    while len(saved) < CHECKPOINTS:
      if process.poll() is not None or time.monotonic() > deadline:
        raise RuntimeError(output.read_text(errors="replace")[-2000:])
      time.sleep(0.2)
      try:
        peak, now = memory(process.pid)
      except ProcessLookupError:
        continue  # It has ended.
      rows = testing.rows(run)
      saved = [row for row in rows if "checkpoint/wall_s" in row]
      steady += [now] if saved else []
  finally:
    process.send_signal(signal.SIGTERM)
    process.wait()
  steps = config.rollout_length * config.env.worlds
  laps = [steps / row["time/sps_e2e"] for row in rows[1:]]
  return {
    "peak_gb": peak / 1e9,
    "steady_gb": statistics.median(steady) / 1e9,
    "checkpoint_s": statistics.median(row["checkpoint/wall_s"] for row in saved),
    "checkpoint_mib": statistics.median(row["checkpoint/mib"] for row in saved),
    "iteration_s": statistics.median(laps),
    "longest_s": max(laps),
  }


def memory(pid: int) -> tuple[int, int]:
  """Returns the largest and the present resident memory of a process in bytes.

  Raises:
    ProcessLookupError: It has ended.
  """
  lines = Path(f"/proc/{pid}/status").read_text().splitlines()
  status = dict(line.split(":", 1) for line in lines)
  if "VmHWM" not in status:
    raise ProcessLookupError(f"process {pid} has ended")
  peak, now = (1024 * int(status[key].split()[0]) for key in ("VmHWM", "VmRSS"))
  return peak, now


if __name__ == "__main__":
  main()
