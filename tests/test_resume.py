"""A run that is killed, stopped and resumed is the run it would have been.

Real processes on the native engine, which are expensive to start: each proves several
promises. What they found is in ``docs/reliability.md``.
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
import tiny

from apnpql_jax import checkpoint

PATIENCE_S = 900
FOR_EVER = ("--total-steps", "100000")


def _wait(process: subprocess.Popen[bytes], said: Path, word: str = "%)") -> None:
  """Until a process just started says ``word``, or that an iteration is done."""
  before, deadline = said.read_text().count(word), time.monotonic() + PATIENCE_S
  while said.read_text().count(word) == before:
    assert process.poll() is None and time.monotonic() < deadline, said.read_text()
    time.sleep(0.02)


def _finish(process: subprocess.Popen[bytes], said: Path) -> None:
  assert process.wait(PATIENCE_S) == 0, said.read_text()[-2000:]


@pytest.mark.parametrize(
  "kills", [2, pytest.param(20, marks=pytest.mark.slow, id="20")]
)
def test_a_run_killed_at_random_moments_ends_as_if_nothing_had_been(tmp_path, kills):
  rng, said, run = np.random.default_rng(kills), tmp_path / "said", tmp_path / "run"
  demos, same = tmp_path / "demos.npz", tmp_path / "same.npz"
  for path in (demos, same):
    tiny.write_demonstrations(path)

  # While the iteration is being compiled there is nothing to wait for.
  process = tiny.start(run, *FOR_EVER, "--replay.demonstrations", str(demos), said=said)
  _wait(process, said, "compiling")
  process.send_signal(signal.SIGINT)
  assert process.wait(30) == 128 + signal.SIGINT
  *_, told, last = said.read_text().splitlines()
  assert "compiling" in told and last.startswith("apnpql: stopped before the first")
  assert f"16 instants of {demos} for 32 slots" in said.read_text()

  lost, saving = [], 0
  for _ in range(kills):
    process = tiny.start(run, *FOR_EVER, said=said)
    _wait(process, said)
    time.sleep(rng.uniform(0.0, 3.0))
    process.kill()
    process.wait()
    reached, saved = tiny.rows(run)[-1]["step"], checkpoint.latest_step(run) or 0
    lost.append(reached - saved)
    saving += any((run / "checkpoints").glob("*tmp*"))
    print(f"lost {lost[-1]} of {reached}", flush=True)
    if saved:  # From the first checkpoint on nobody needs the file.
      demos.unlink(missing_ok=True)
  # An interval, and what is trained while a checkpoint is being written.
  assert max(lost) <= 2 * tiny.CONFIG.checkpoint_every
  print(f"{kills} kills, {saving} while saving; environment steps lost: {lost}")

  process = tiny.start(run, *FOR_EVER, said=said)
  _wait(process, said)
  process.terminate()
  assert process.wait(PATIENCE_S) == 128 + signal.SIGTERM
  stopped = checkpoint.latest_step(run)
  assert f"saved at step {stopped:,}; to go on: --resume {run}" in said.read_text()

  # Evaluations are none of the training's business.
  total = str(tiny.rows(run)[-1]["step"] + 16 * tiny.STEPS)
  other = ["--total-steps", total, "--eval-episodes", "2"]
  other += ["--replay.demonstrations", str(same)]
  straight, log = tmp_path / "straight", tmp_path / "log"
  together = [
    tiny.start(run, "--total-steps", total, said=said),
    tiny.start(straight, *other, said=log, log_compiles=True),
  ]
  for process in together:
    _finish(process, said)
  bits = tiny.saved_bytes(run, int(total))
  assert bits == tiny.saved_bytes(straight, int(total)) and len(bits) > 50
  # Each iteration stands once in the metrics, with the same figures.
  losses = [
    [(row["step"], row["loss/q"]) for row in tiny.rows(folder) if "loss/q" in row]
    for folder in (run, straight)
  ]
  assert losses[0] == losses[1] and len(losses[0]) == int(total) // tiny.STEPS
  # What the processes before compiled is not compiled again, and after the first
  # iteration nothing is but the evaluation.
  compiled = log.read_text().partition(" 8 of ")[2].count("Finished XLA compilation")
  assert log.read_text().count("compilation of jit(iteration)") == 1
  assert "compilation cache hit for 'jit_iteration'" in log.read_text()
  assert 0 < compiled < 8 < len(losses[1])


@pytest.mark.slow
@pytest.mark.parametrize(
  ("backend", "obs"), [("mjx", "state"), ("native", "pixels"), ("mjx", "pixels")]
)
def test_a_run_resumed_in_a_new_process_is_the_run_that_was_not(backend, obs):
  """For other engines and observations, compiled as any run is."""
  command = [sys.executable, "-m", "benchmarks.reliability.resume"]
  command += ["--backend", backend, "--obs", obs]
  env = os.environ | {"PYTHONPATH": str(tiny.ROOT)}
  done = subprocess.run(command, env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
