"""Metric files and the progress display."""

from __future__ import annotations

import errno
import io
import json
import os
from pathlib import Path
import struct
import sys
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto import event_pb2
from terminals import read_all, terminal

from apnpql_jax.config import codec
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.console import print_line
from apnpql_jax.errors import UserError
from apnpql_jax.runs import metrics
from apnpql_jax.runs.progress import TrainProgress
from apnpql_jax.runs.sinks import check_sinks, make_sinks


class Clock:
  """A clock that a test moves by hand."""

  def __init__(self):
    self.now = 1000.0

  def __call__(self) -> float:
    return self.now


def _jsonl(folder: Path) -> list[dict[str, float]]:
  lines = (folder / "metrics.jsonl").read_text().splitlines()
  return [json.loads(line) for line in lines]


def test_rows_are_on_disk_at_once(tmp_path: Path):
  clock = Clock()
  writer = metrics.MetricWriter(tmp_path, clock=clock)
  clock.now += 2.5
  values = {"loss": jnp.float32(0.25), "updates": np.int64(2**53), "flag": True}
  writer.write(64, values)
  row = {"step": 64, "time/wall_s": 2.5, "loss": 0.25, "updates": 2**53, "flag": 1}
  assert _jsonl(tmp_path) == [row]
  with pytest.raises((TypeError, ValueError)):
    writer.write(65, {"vector": np.zeros(2)})
  assert _jsonl(tmp_path) == [row]


def test_non_finite_values_become_null(tmp_path: Path):
  with metrics.MetricWriter(tmp_path) as writer:
    writer.write(4, {"b": float("nan"), "c": float("inf")})
  # Strict JSON: no NaN token, which most readers reject.
  (row,) = _jsonl(tmp_path)
  assert row["b"] is None and row["c"] is None
  assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_a_resumed_run_appends_and_its_clock_continues(tmp_path: Path):
  clock = Clock()
  with metrics.MetricWriter(tmp_path, clock=clock) as writer:
    for step in (10, 20, 30):
      clock.now += 5
      writer.write(step, {"a": float(step)})
  with (tmp_path / "metrics.jsonl").open("a") as file:
    file.write('{"step": 40, "a": 4')  # Killed in the middle of a line.
  (tmp_path / "metrics.csv").write_text("step\n10\n")  # Earlier versions wrote one.
  clock.now += 1000
  with metrics.MetricWriter(tmp_path, resume_step=20, clock=clock) as writer:
    clock.now += 3
    writer.write(25, {"b": 1.0})
  assert [row["step"] for row in _jsonl(tmp_path)] == [10, 20, 25]
  assert [row["time/wall_s"] for row in _jsonl(tmp_path)] == [5.0, 10.0, 13.0]
  assert (tmp_path / "metrics.csv").read_text() == "step\n10\n"


def test_large_files_are_renamed_and_taken_back(tmp_path: Path):
  with metrics.MetricWriter(tmp_path, max_bytes=300) as writer:
    for step in range(1, 31):
      writer.write(step, {metrics.SUCCESS: step / 30, "loss": 0.5})
  files = metrics.metric_files(tmp_path)
  names = [f"metrics.{n}.jsonl" for n in range(1, len(files))] + ["metrics.jsonl"]
  assert [path.name for path in files] == names and len(files) > 3
  assert all(path.stat().st_size < 400 for path in files)
  steps = [row["step"] for path in files for row in metrics.read_rows(path)]
  assert steps == list(range(1, 31))
  assert [row["step"] for row in metrics.read_evaluations(tmp_path)] == steps
  # A run that resumes within the second file drops those after it.
  resume = metrics.read_rows(files[1])[0]["step"]
  with metrics.MetricWriter(tmp_path, resume_step=int(resume or 0)) as writer:
    writer.write(99, {"loss": 1.0})
  left = {path.name for path in tmp_path.iterdir()}
  assert left == {"metrics.jsonl", "metrics.1.jsonl"}
  rows = metrics.read_rows(tmp_path / "metrics.jsonl")
  assert [row["step"] for row in rows] == [resume, 99]


@pytest.mark.parametrize("line", ["oops", '{"a": 1}', "[1]", '{"step": "x"}'])
def test_a_damaged_line_is_left_out_and_kept(line: str, tmp_path: Path, capfd):
  path = tmp_path / "metrics.jsonl"
  text = f'{{"step": 1}}\n{line}\n{{"step": 2}}\n{{"step": 3}}\n'
  path.write_text(text)
  with pytest.raises(UserError, match=r"metrics.jsonl, line 2: not a row"):
    metrics.read_rows(path)
  metrics.MetricWriter(tmp_path, resume_step=2).close()
  assert [row["step"] for row in metrics.read_rows(path)] == [1, 2]
  assert (tmp_path / "metrics.damaged.jsonl").read_text() == text
  assert "line 2: not a row of metrics; left out" in capfd.readouterr().err
  assert metrics.metric_files(tmp_path) == [path]


def test_more_sinks_get_the_same_numbers(tmp_path: Path):
  class Memory:
    def __init__(self):
      self.rows, self.closed = [], False

    def write(self, step, row):
      self.rows.append((step, dict(row)))

    def close(self):
      self.closed = True

  sink = Memory()
  with metrics.MetricWriter(tmp_path, sinks=[sink]) as writer:
    writer.write(3, {"a": jnp.float32(0.5)})
    assert not sink.closed
  assert sink.rows == [(3, {"a": 0.5})] and sink.closed


class FullDisk(io.StringIO):
  """A stream to a file on a full disk."""

  def write(self, text: str) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_progress_goes_on_if_its_stream_is_full_or_closed(monkeypatch):
  closed = io.StringIO()
  closed.close()
  for stream in (FullDisk(), closed, None):
    monkeypatch.setattr(sys, "stderr", stream)
    with TrainProgress(10, period_s=0) as progress:
      progress.update(5, updates=1)
      progress.message("half")
    print_line("done")


def test_a_broken_sink_costs_no_rows(tmp_path: Path, capsys):
  class Broken:
    def write(self, step: int, row: object) -> None:
      raise RuntimeError("no network")

    def close(self) -> None:
      raise AssertionError("was dropped")

  with metrics.MetricWriter(tmp_path, sinks=[Broken()]) as writer:
    writer.write(1, {"a": 0.5})
    writer.write(2, {"a": 0.5})
  assert [row["step"] for row in metrics.read_rows(tmp_path / "metrics.jsonl")] == [
    1,
    2,
  ]
  assert capsys.readouterr().err.count("no network") == 1


def _shown(folder: Path) -> list[tuple[int, str, float]]:
  """Returns what TensorBoard shows of event files: (step, name, value).

  A start event discards what came before it from its step on.
  """
  shown: list[tuple[int, str, float]] = []
  for path in sorted(folder.iterdir()):
    data, at = path.read_bytes(), 0
    while at < len(data):  # Records of TFRecord: length, its check, event, its check.
      (length,) = struct.unpack_from("<Q", data, at)
      event = event_pb2.Event.FromString(data[at + 12 : at + 12 + length])
      if event.session_log.status == event_pb2.SessionLog.START:
        shown = [item for item in shown if item[0] < event.step]
      shown += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
      at += 16 + length
  return shown


def test_tensorboard_shows_every_number_once_also_after_a_resume(tmp_path: Path):
  check_sinks(["tensorboard"])
  (sink,) = make_sinks(["tensorboard"], tmp_path, {"seed": 0})
  for step in (1, 2, 3):
    sink.write(step, {"a/b": 0.5, "c": -2.0})
  sink.close()
  time.sleep(1.1)  # Names of event files hold the second.
  (sink,) = make_sinks(["tensorboard"], tmp_path, {"seed": 0}, resume_step=1)
  for step in (2, 3):
    sink.write(step, {"a/b": 0.25})
  sink.close()
  expected = [(1, "a/b", 0.5), (1, "c", -2.0), (2, "a/b", 0.25), (3, "a/b", 0.25)]
  assert _shown(tmp_path / "tensorboard") == expected


def test_a_resume_continues_the_run_of_wandb(tmp_path: Path, monkeypatch):
  pytest.importorskip("wandb")
  monkeypatch.setenv("WANDB_MODE", "offline")
  config = dict(codec.flatten(TrainConfig()))
  for changed in ({}, {"total_steps": 1}, {"wandb_id": "mine"}):
    (sink,) = make_sinks(["wandb"], tmp_path, config | changed, resume_step=1)
    sink.write(3, {"a/b": 0.5})
    sink.close()
  folders = (tmp_path / "wandb").glob("offline-run-*")
  ids = {path.name.rpartition("-")[2] for path in folders}
  assert len(ids) == 2 and "mine" in ids


def test_a_sink_that_cannot_be_opened_costs_no_run(tmp_path: Path, capsys):
  (tmp_path / "tensorboard").write_text("a file")
  assert make_sinks(["tensorboard"], tmp_path, {}) == []
  (line,) = capsys.readouterr().err.splitlines()
  assert line.startswith("cannot open the metric sink tensorboard: ")


def test_extras_that_are_unknown_or_missing_are_named(monkeypatch: pytest.MonkeyPatch):
  with pytest.raises(UserError, match="choose from tensorboard, wandb"):
    check_sinks(["tensorflow"])
  for name, package, extra in (
    ("tensorboard", "tensorboardX", "tb"),
    ("wandb", "wandb", "wandb"),
  ):
    monkeypatch.delitem(sys.modules, package, raising=False)
    monkeypatch.setattr(sys, "path", [])  # As if nothing were installed.
    with pytest.raises(UserError, match=rf"{package}, .*apnpql-jax\[{extra}\]"):
      check_sinks([name])
  check_sinks([])


def test_evaluations_are_read_again_if_the_run_renames_its_file(tmp_path, monkeypatch):
  row = {metrics.STEP: 1, metrics.SUCCESS: 0.5}
  path = tmp_path / "metrics.jsonl"
  path.write_text(json.dumps(row) + "\n")
  read = metrics.read_rows

  def read_late(*args: Any, **options: Any) -> list[metrics.Row]:
    monkeypatch.setattr(metrics, "read_rows", read)
    path.rename(tmp_path / "metrics.1.jsonl")
    return read(*args, **options)

  monkeypatch.setattr(metrics, "read_rows", read_late)
  assert metrics.read_evaluations(tmp_path) == [row]


def test_progress_prints_plain_lines_where_there_is_no_terminal(capsys):
  clock, stream = Clock(), io.StringIO()
  with TrainProgress(1000, stream=stream, period_s=10, clock=clock) as progress:
    clock.now += 100.0  # The first compilation.
    progress.update(100, updates=7)
    for i in range(1, 6):
      clock.now += 4.0
      progress.update(100 + 80 * i, updates=7 + 40 * i, success_rate=0.25)
      progress.update(100 + 80 * i, updates=7 + 40 * i)
    progress.message(f"checkpoint [1] written{'.' * 100}")
  lines = stream.getvalue().splitlines()
  assert lines[0] == "step 100 of 1,000 (10 %)  success --  -:--:-- left"
  # 80 steps and 40 updates every 4 s; at 340, 660 steps are left.
  figures = "success 25 %  20 steps/s  10.0 updates/s  0:00:33 left"
  assert lines[1] == f"step 340 of 1,000 (34 %)  {figures}"
  assert lines[2] == f"checkpoint [1] written{'.' * 100}"
  assert lines[3].startswith("step 500 of 1,000 (50 %)") and len(lines) == 4
  assert capsys.readouterr() == ("", "")


def test_speeds_of_a_resumed_run_leave_out_what_came_before():
  clock, stream = Clock(), io.StringIO()
  with TrainProgress(10_000, stream=stream, period_s=0, clock=clock) as progress:
    progress.update(5_000, updates=700)
    clock.now += 60.0  # A slow iteration.
    progress.update(5_120, updates=706)
  figures = "success --  2 steps/s  0.1 updates/s  0:40:40 left"
  assert stream.getvalue().splitlines()[1].endswith(figures)


def test_progress_draws_a_bar_on_a_terminal():
  controller, end = terminal(80)
  clock = Clock()
  with os.fdopen(end, "w", encoding="utf-8") as stream:
    with TrainProgress(1000, stream=stream, clock=clock) as progress:
      progress.update(100, updates=20)
      clock.now += 10.0
      progress.update(500, updates=100, success_rate=0.5)
      progress.message("a [bracketed] note")
  text = read_all(controller)
  assert "50%" in text and "success 50 %  40 steps/s  8.0 updates/s" in text
  assert "0:00:13" in text  # Left: 500 steps at 40 a second.
  assert "a [bracketed] note" in text and "\x1b[" in text


def test_progress_writes_to_standard_error_only(capsys):
  with TrainProgress(10) as progress:
    progress.update(5, updates=1)
  out, err = capsys.readouterr()
  assert out == "" and "step 5 of 10" in err
