"""The time that a run has left, evaluations included, and its display."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys

import pytest
from terminals import read_all, terminal

from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.testing import ROOT


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


def environment() -> dict[str, str]:
  env = os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color"}
  return {name: value for name, value in env.items() if name != "COLUMNS"}


@pytest.mark.parametrize("columns", [40, 60, 80, 100])
def test_success_and_time_left_fit_the_terminal(columns):
  controller, end = terminal(columns)
  subprocess.run([sys.executable, "-c", SHOWN], stderr=end, env=environment())
  os.close(end)
  text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", read_all(controller))
  lines = re.split(r"[\r\n]+", text)
  last = [line for line in lines if line][-1]
  assert " 50% success 100 %" in last and last.endswith(">0:00:51 left")
  assert len(last) <= columns and ("10,240 steps" in last) == (columns == 100)


RECORDED = (
  (8, 0.2, 0.0),
  (400, 1.1, 0.0),
  (800, 2.1, 0.0),
  (1200, 3.1, 0.0),
  (1504, 32.2, 28.4),
  (1600, 33.9, 0.0),
  (2000, 36.4, 0.0),
  (2400, 43.7, 0.0),
  (2800, 47.9, 0.0),
  (3000, 57.6, 7.6),
  (3200, 60.2, 0.0),
  (3600, 64.1, 0.0),
  (4000, 68.2, 0.0),
  (4400, 73.5, 0.0),
  (4504, 84.1, 9.5),
  (4800, 87.9, 0.0),
  (5200, 92.2, 0.0),
  (5600, 96.3, 0.0),
  (6000, 98.5, 0.0),
  (6000, 102.5, 4.0),
  (6400, 106.2, 0.0),
  (6800, 109.1, 0.0),
  (7200, 113.2, 0.0),
  (7504, 124.5, 7.8),
  (7600, 126.2, 0.0),
  (8000, 130.4, 0.0),
  (8000, 137.7, 7.3),
)
"""Step, wall clock and seconds of evaluation in rows of ``metrics.jsonl`` of a run with
TINY_ARGS, --total-steps 8000, --eval-every 1500, --eval-episodes 32 and
--checkpoint-every 2000, on a core that other processes used too."""


def test_at_half_time_a_run_had_about_as_much_left_as_shown():
  now, stream = 0.0, io.StringIO()
  progress = TrainProgress(
    8000, eval_every=1500, stream=stream, period_s=0, clock=lambda: now
  )
  half = None
  with progress:
    for step, at, seconds in RECORDED:
      if seconds:
        now = at - seconds
        with progress.evaluation():
          now = at
        continue
      now = at
      progress.update(step, updates=step // 4)
      if step >= 4000 and half is None:
        half = now
  line = next(x for x in stream.getvalue().splitlines() if x.startswith("step 4,"))
  hours, minutes, seconds = map(int, re.findall(r"(\d+):(\d\d):(\d\d) left", line)[0])
  assert half is not None
  left = 3600 * hours + 60 * minutes + seconds
  assert left == pytest.approx(RECORDED[-1][1] - half, rel=0.3)
