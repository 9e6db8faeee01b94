"""The time that a run has left, evaluations included, and its display."""

from __future__ import annotations

import fcntl
import io
import os
from pathlib import Path
import pty
import re
import struct
import subprocess
import sys
import termios
import time

import pytest

from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.testing import ROOT, TINY_ARGS


class Run:
  """A run of 1,000 steps at 10 steps/s that is evaluated every 250 steps."""

  def __init__(self, total: int = 1000):
    self.now, self.stream = 0.0, io.StringIO()
    self.progress = TrainProgress(
      total, eval_every=250, stream=self.stream, period_s=0, clock=lambda: self.now
    )

  def train(self, first: int, last: int) -> None:
    for step in range(first, last + 1, 10):
      self.progress.update(step, updates=step)
      self.now += 1.0

  def evaluate(self, seconds: float) -> None:
    with self.progress.evaluation():
      self.now += seconds

  def left(self) -> str:
    """Returns the estimate of the last line."""
    line = self.stream.getvalue().splitlines()[-1]
    return line.removesuffix(" left").rpartition("  ")[2]


def test_time_left_is_that_of_steps_and_evaluations():
  run = Run()
  with run.progress:
    run.train(0, 240)
    assert run.left() == ">0:01:16"  # 760 steps; evaluations are not yet known.
    run.progress.update(250, updates=250)
    run.evaluate(60.0)  # It compiles.
    run.train(250, 490)
    assert run.left() == "0:03:51"  # 510 steps and three evaluations of 60 s.
    run.progress.update(500, updates=500)
    run.evaluate(20.0)
    run.progress.update(500, updates=500)
    assert run.left() == "0:01:30"  # 500 steps and two evaluations of 20 s.
    assert "10 steps/s" in run.stream.getvalue().splitlines()[-1]


def test_the_evaluation_at_the_end_counts_if_the_steps_are_no_multiple():
  run = Run(total=260)
  with run.progress:
    run.train(0, 240)
    run.progress.update(250, updates=250)
    run.evaluate(7.0)
    run.progress.update(250, updates=250)
    assert run.left() == "0:00:08"


SHOWN = """
from apnpql_jax.runs.progress import TrainProgress
now = 0.0
with TrainProgress(20480, eval_every=5120, clock=lambda: now) as progress:
  progress.update(128, updates=32)
  now += 50.0
  progress.update(10240, updates=2560, success_rate=1.0)
"""


def terminal(columns: int) -> tuple[int, int]:
  controller, end = pty.openpty()
  fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
  return controller, end


def environment() -> dict[str, str]:
  env = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color"}
  return {name: value for name, value in env.items() if name != "COLUMNS"}


@pytest.mark.parametrize("columns", [40, 60, 80, 100])
def test_success_and_time_left_fit_the_terminal(columns):
  controller, end = terminal(columns)
  subprocess.run([sys.executable, "-c", SHOWN], stderr=end, env=environment())
  os.close(end)
  text = os.read(controller, 1 << 16).decode()
  os.close(controller)
  lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text))
  last = [line for line in lines if line][-1]
  assert " 50% success 100 %" in last and last.endswith(">0:00:51 left")
  assert len(last) <= columns and ("10,240 steps" in last) == (columns == 100)


@pytest.mark.slow
def test_at_half_time_a_run_has_about_as_much_left_as_it_shows(tmp_path: Path):
  controller, end = terminal(100)
  args = "--total-steps 8000 --eval-every 1000 --checkpoint-every 2000".split()
  run = ["train", "push_plate", "--run", str(tmp_path / "run"), *TINY_ARGS, *args]
  process = subprocess.Popen(
    [sys.executable, "-m", "apnpql_jax", *run],
    stdout=end,
    stderr=end,
    env=environment(),
  )
  os.close(end)
  shown: list[tuple[float, int, float]] = []  # clock, percent, seconds left
  try:
    while part := os.read(controller, 1 << 16).decode(errors="replace"):
      for done, hours, minutes, seconds in re.findall(
        r"(\d+)%[^%]*%[^%]*?(\d+):(\d\d):(\d\d) left", part
      ):
        left = 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        shown.append((time.monotonic(), int(done), left))
  except OSError:  # The process has ended.
    pass
  os.close(controller)
  finished = time.monotonic()
  assert process.wait() == 0
  at, _, left = next(row for row in shown if row[1] >= 50)
  assert left == pytest.approx(finished - at, rel=0.3)
