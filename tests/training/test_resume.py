"""A run that is killed, stopped and resumed ends like an undisturbed one.

Uses real processes on the native engine. They are expensive to start, so each checks
several promises. ``docs/reliability.md`` reports the results.
"""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from apnpql_jax import testing
from apnpql_jax.data import demonstrations
from apnpql_jax.primitives.reset_bank import load_bank
from apnpql_jax.runs import checkpoint_reader
from apnpql_jax.tasks import make_task

PATIENCE_S = 900
FOR_EVER = ("--total-steps", "100000")


def _wait(process: subprocess.Popen[bytes], log: Path, word: str = "%)") -> None:
  """Waits until a new process prints ``word``; by default, an iteration is done."""
  before, deadline = log.read_text().count(word), time.monotonic() + PATIENCE_S
  while log.read_text().count(word) == before:
    assert process.poll() is None and time.monotonic() < deadline, log.read_text()
    time.sleep(0.02)


def _finish(process: subprocess.Popen[bytes], log: Path) -> None:
  assert process.wait(PATIENCE_S) == 0, log.read_text()[-2000:]


def _write_demonstrations(path: Path) -> None:
  """Writes four episodes of four time steps, in which the arm holds still."""
  env = testing.TINY.env
  task = make_task(env.task)
  bank, _ = load_bank(task, env.bank_rows)
  rows = np.arange(16) // 4
  still = demonstrations.Demonstrations(
    qpos=np.asarray(bank.qpos)[rows],
    qvel=np.zeros((16, task.scene.model.nv), np.float32),
    mocap_pos=np.asarray(bank.mocap_pos)[rows],
    mocap_quat=np.asarray(bank.mocap_quat)[rows],
    variant=np.asarray(bank.variant)[rows],
    action=np.zeros((16, 7), np.float32),
    first=np.arange(16) % 4 == 0,
  )
  period_s = env.control_period_s
  demonstrations.save(path, still, task=env.task, control_period_s=period_s)


@pytest.mark.parametrize(
  "kills", [1, pytest.param(20, marks=pytest.mark.slow, id="20")]
)
def test_a_run_killed_at_random_times_ends_like_an_undisturbed_one(tmp_path, kills):
  rng, log, run = np.random.default_rng(kills), tmp_path / "log", tmp_path / "run"
  demos, same = tmp_path / "demos.npz", tmp_path / "same.npz"
  for path in (demos, same):
    _write_demonstrations(path)

  # During compilation there is nothing to save, so a signal ends the process at once.
  options = ["--replay.allow-unsolved", "--replay.demonstrations"]
  process = testing.start(run, *FOR_EVER, *options, str(demos), log=log)
  _wait(process, log, "compiling")
  process.send_signal(signal.SIGINT)
  assert process.wait(30) == 128 + signal.SIGINT
  *_, before, last = log.read_text().splitlines()
  assert "compiling" in before and last.startswith("apnpql: stopped before the first")
  assert f"32 slots from 16 instants of {demos}" in log.read_text()

  lost, saving = [], 0
  for _ in range(kills):
    process = testing.start(run, *FOR_EVER, log=log)
    _wait(process, log)
    time.sleep(rng.uniform(0.0, 3.0))
    process.kill()
    process.wait()
    reached, saved = (
      testing.rows(run)[-1]["step"],
      checkpoint_reader.latest_step(run) or 0,
    )
    lost.append(reached - saved)
    saving += any((run / "checkpoints").glob("*tmp*"))
    print(f"lost {lost[-1]} of {reached}", flush=True)
    if saved:  # The file is not needed after the first checkpoint.
      demos.unlink(missing_ok=True)
  # At most an interval and the steps trained while a checkpoint is being written.
  assert max(lost) <= 2 * testing.TINY.checkpoint_every
  print(f"{kills} kills, {saving} while saving; environment steps lost: {lost}")

  process = testing.start(run, *FOR_EVER, log=log)
  _wait(process, log)
  process.send_signal(signal.SIGINT)
  assert process.wait(PATIENCE_S) == 128 + signal.SIGINT
  stopped = checkpoint_reader.latest_step(run)
  assert f"saved at step {stopped:,}; to continue: --resume {run}" in log.read_text()

  # Evaluations must not affect training.
  total = str(testing.rows(run)[-1]["step"] + 16 * testing.STEPS)
  other = ["--total-steps", total, "--eval-episodes", "2"]
  other += [*options, str(same)]
  straight, straight_log = tmp_path / "straight", tmp_path / "straight_log"
  together = [
    testing.start(run, "--total-steps", total, log=log),
    testing.start(straight, *other, log=straight_log, log_compiles=True),
  ]
  for process in together:
    _finish(process, log)
  bits = testing.saved_bytes(run, int(total))
  assert bits == testing.saved_bytes(straight, int(total)) and len(bits) > 50
  # Each iteration is in the metrics once, with the same numbers.
  losses = [
    [(row["step"], row["loss/q"]) for row in testing.rows(folder) if "loss/q" in row]
    for folder in (run, straight)
  ]
  assert losses[0] == losses[1] and len(losses[0]) == int(total) // testing.STEPS
  # Nothing that earlier processes compiled is compiled again, and after the first
  # iteration nothing but the evaluation is.
  compiled = (
    straight_log.read_text().partition(" 8 of ")[2].count("Finished XLA compilation")
  )
  assert straight_log.read_text().count("compilation of jit(iteration)") == 1
  assert "compilation cache hit for 'jit_iteration'" in straight_log.read_text()
  assert 0 < compiled < 8 < len(losses[1])


@pytest.mark.slow
@pytest.mark.parametrize(
  ("backend", "obs"), [("mjx", "state"), ("native", "pixels"), ("mjx", "pixels")]
)
def test_a_run_resumed_in_a_new_process_equals_an_undisturbed_one(backend, obs):
  """Covers other engines and observations, compiled like any run."""
  command = [sys.executable, "-m", "benchmarks.reliability.resume"]
  command += ["--backend", backend, "--obs", obs]
  env = os.environ | {"PYTHONPATH": str(testing.ROOT)}
  done = subprocess.run(command, env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
