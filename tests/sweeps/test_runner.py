"""Sweeps of real processes that stand for trainings: pinning, failures, signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import errno
import io
import os
from pathlib import Path
import signal
import sys
import textwrap
import threading
import time

from hypothesis import given, strategies as st
import pytest
from rich.console import Console
from run_files import make_run

from apnpql_jax.errors import FileError
from apnpql_jax.runs import run_folder
from apnpql_jax.sweeps.display import SweepDisplay
from apnpql_jax.sweeps.following import Follower, last_line
from apnpql_jax.sweeps.launcher import Job, Launcher, Work
from apnpql_jax.sweeps.local import LocalLauncher, available_cores, shares
from apnpql_jax.sweeps.manifest import (
  DONE,
  FAILED,
  MANIFEST_FILE,
  RUNNING,
  STOPPED,
  WAITING,
  Entry,
  Manifest,
  load_manifest,
)
from apnpql_jax.sweeps.runner import Runner
from apnpql_jax.sweeps.slurm import SlurmLauncher


class Script(Work):
  """Work whose options are a Python program."""

  def command(self) -> list[str]:
    """Returns the command that runs the program in the folder of the sweep."""
    return [sys.executable, "-c", *self.argv]


class Scripts(Manifest):
  """Manifest of programs."""

  def work(self, entry: Entry) -> Work:
    """Returns the program of an entry."""
    return Script(*super().work(entry))


def sweep_of(folder: Path, *programs: str) -> Manifest:
  """Returns a sweep of programs, named a, b and so on."""
  names = "abcdefgh"
  argvs = [[textwrap.dedent(program)] for program in programs]
  return Scripts(
    folder, [Entry(n, argv) for n, argv in zip(names, argvs, strict=False)]
  )


def run(
  sweep: Manifest,
  *,
  jobs: int = 1,
  caught: list[int] | None = None,
  show: Callable[[], None] = lambda: None,
) -> list[str]:
  """Runs a sweep and returns the names of runs in the order in which they started."""
  started = []

  def report(entry: Entry) -> None:
    if entry.state == RUNNING:
      started.append(entry.name)

  caught = [] if caught is None else caught
  Runner(sweep, LocalLauncher(jobs), report).run(caught, show)
  return started


def test_a_failed_run_costs_the_others_nothing_and_is_retried(tmp_path):
  once = f"""
    import pathlib, sys
    path = pathlib.Path({str(tmp_path / "tried")!r})
    if not path.exists():
      path.touch()
      sys.exit("first line\\napnpql: no luck")
  """
  sweep = sweep_of(tmp_path, once, "", "import os; os.kill(os.getpid(), 9)")
  assert run(sweep) == ["a", "b", "c"]
  assert [entry.state for entry in sweep.runs] == ["failed", "done", "failed"]
  first, _, third = load_manifest(tmp_path).runs
  assert (first.code, first.line) == (1, "apnpql: no luck")
  assert third.code == -9 and "killed by signal 9" in third.line
  make_run(tmp_path / "b", [0.5])  # What a training would have left.
  assert run(sweep) == ["a", "c"]
  first, second, _ = load_manifest(tmp_path).runs
  assert (first.state, first.attempts, first.line) == (DONE, 2, "")
  assert (second.state, second.attempts) == (DONE, 1)


def test_what_another_process_has_saved_meanwhile_is_kept(tmp_path):
  """Its job has ended, and its attempts count."""
  program = f"open({str(tmp_path / 'started')!r}, 'x')"
  sweep = sweep_of(tmp_path, program)
  meanwhile = sweep_of(tmp_path, program)
  meanwhile.runs[0].attempts, meanwhile.runs[0].job = 3, "17"
  meanwhile.save()
  run(sweep)
  (entry,) = load_manifest(tmp_path).runs
  assert entry.attempts == 4 and (tmp_path / "started").exists()


def test_a_run_that_cannot_be_started_costs_the_others_nothing(tmp_path):
  sweep = sweep_of(tmp_path, "", "")
  (tmp_path / "a.log").mkdir()
  run(sweep)
  assert [entry.state for entry in sweep.runs] == ["failed", "done"]
  assert "Is a directory" in sweep.runs[0].line


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only on Linux")
def test_runs_at_the_same_time_have_cores_of_their_own(tmp_path, monkeypatch):
  monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
  program = """
    import os, time
    time.sleep(1)
    print(*sorted(os.sched_getaffinity(0)), os.environ["CUDA_VISIBLE_DEVICES"], sep=",")
  """
  sweep = sweep_of(tmp_path, program, program)
  run(sweep, jobs=2)
  found = [last_line(tmp_path / f"{name}.log").split(",") for name in "ab"]
  expected = [list(map(str, share)) for share in shares(available_cores(), 2)]
  assert found == [[*expected[0], "0"], [*expected[1], "1"]]


@pytest.mark.parametrize(
  ("count", "expected"),
  [
    (1, [[0, 1, 2, 3, 4]]),
    (2, [[0, 1], [2, 3, 4]]),
    (5, [[0], [1], [2], [3], [4]]),
    (7, [[0], [0], [1], [2], [2], [3], [4]]),
  ],
)
def test_shares_are_neighbors_and_none_is_empty(count, expected):
  assert shares(range(5), count) == expected


@given(size=st.integers(1, 16), count=st.integers(1, 40))
def test_all_items_are_shared_and_as_evenly_as_possible(size, count):
  found = shares(range(size), count)
  assert all(found) and len(found) == count
  used = [sum(item in share for share in found) for item in range(size)]
  assert min(used) >= max(1, count // size) and max(used) <= -(-count // size)


def test_runs_that_share_a_gpu_do_not_reserve_more_than_its_memory(
  tmp_path, monkeypatch
):
  monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
  program = """
    import os, time
    time.sleep(1)
    names = "CUDA_VISIBLE_DEVICES", "XLA_PYTHON_CLIENT_MEM_FRACTION"
    print(*map(os.environ.get, names))
  """
  run(sweep_of(tmp_path, *4 * [program]), jobs=4)
  found = [last_line(tmp_path / f"{name}.log").split() for name in "abcd"]
  assert found == [["0", "0.450"], ["0", "0.450"], ["1", "0.450"], ["1", "0.450"]]


WAITING_SCRIPT = """
    import signal, sys, time
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(print("saved") or 143))
    print("ready", flush=True)
    time.sleep(60)
"""
"""Program that ends at SIGTERM as a training does."""


def test_a_signal_reaches_the_runs_and_starts_no_more(tmp_path):
  sweep = sweep_of(tmp_path, *3 * [WAITING_SCRIPT])
  caught: list[int] = []

  def interrupt() -> None:
    logs = [tmp_path / "a.log", tmp_path / "b.log"]
    while not all(log.exists() and log.read_text() for log in logs):
      time.sleep(0.05)
    caught.append(2)

  threading.Thread(target=interrupt).start()
  assert run(sweep, jobs=2, caught=caught) == ["a", "b"]
  assert [entry.state for entry in sweep.runs] == ["stopped", "stopped", "waiting"]
  assert [entry.line for entry in sweep.runs[:2]] == ["saved", "saved"]


@pytest.mark.skipif(not Path("/proc").exists(), reason="only on Linux")
def test_a_job_whose_time_is_over_saves_and_is_queued_again(tmp_path, monkeypatch):
  """More often than the three times that submitit allows by itself."""
  pytest.importorskip("submitit")
  monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
  program = f"""
    import pathlib, signal, sys, time
    path = pathlib.Path({str(tmp_path)!r}, "saved")
    saves = int(path.read_text()) if path.exists() else 0
    if saves == 4:
      sys.exit(print("resumed"))
    more = str(saves + 1)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(path.write_text(more) and 143))
    print("ready", flush=True)
    time.sleep(600)
  """
  sweep = sweep_of(tmp_path, program)
  settings = {"timeout_min": 10}  # So few that each end counts at once.
  folder = tmp_path / "submitit"
  launcher = SlurmLauncher(folder, cluster="local", settings=settings)
  log = tmp_path / "a.log"

  def over() -> None:
    for number in range(1, 5):
      while not (log.exists() and log.read_text().count("ready") == number):
        time.sleep(0.05)
      job = sweep.runs[0].job
      children = Path(f"/proc/{job}/task/{job}/children").read_text().split()
      os.kill(int(children[0]), signal.SIGUSR2)  # As submitit does before the end.

  threading.Thread(target=over).start()
  Runner(sweep, launcher, lambda _: None).run([], lambda: None)
  assert log.read_text() == 4 * "ready\n" + "resumed\n"
  (entry,) = load_manifest(tmp_path).runs
  assert (entry.state, entry.attempts, entry.code) == (DONE, 1, 0)


def test_a_signal_reaches_jobs_too(tmp_path, monkeypatch):
  pytest.importorskip("submitit")
  monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
  sweep = sweep_of(tmp_path, WAITING_SCRIPT)
  launcher = SlurmLauncher(tmp_path / "submitit", cluster="local")
  caught: list[int] = []
  log = tmp_path / "a.log"

  def show() -> None:
    if log.exists() and log.read_text():
      caught.append(15)

  Runner(sweep, launcher, lambda _: None).run(caught, show)
  assert [(x.state, x.code, x.line) for x in sweep.runs] == [("stopped", 143, "saved")]


class Finding(Launcher):
  """A launcher that finds the processes of an earlier one, as on a cluster."""

  def __init__(self, jobs: int, found: Mapping[str, Job]):
    """Finds the jobs of ``found`` by their names."""
    self.jobs, self._found = jobs, found
    self._local = LocalLauncher(jobs)

  def start(self, work: Work) -> Job:
    """See ``Launcher.start``."""
    return self._local.start(work)

  def find(self, name: str) -> Job | None:
    """See ``Launcher.find``."""
    return self._found.get(name)


def test_jobs_of_an_earlier_process_are_taken_over_and_take_their_room(tmp_path):
  sweep = sweep_of(tmp_path, *2 * ["import time; time.sleep(1)"], "", "")
  earlier, events = LocalLauncher(2), []
  for entry in sweep.runs[:2]:
    entry.attempts, entry.job = 1, f"job of {entry.name}"
  found = {x.job: earlier.start(sweep.work(x)) for x in sweep.runs[:2]}
  sweep.save()
  runner = Runner(sweep, Finding(1, found), lambda x: events.append((x.name, x.state)))
  runner.run([], lambda: None)
  assert events[:2] == [("a", RUNNING), ("b", RUNNING)]
  assert sorted(events[2:4]) == [("a", DONE), ("b", DONE)]
  each = [(name, state) for name in "cd" for state in (RUNNING, DONE)]
  assert events[4:] == each
  assert [(x.attempts, x.job) for x in load_manifest(tmp_path).runs] == 4 * [(1, "")]


def test_a_closed_terminal_leaves_jobs_running(tmp_path, monkeypatch):
  pytest.importorskip("submitit")
  monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
  sweep = sweep_of(tmp_path, WAITING_SCRIPT, "")
  launcher = SlurmLauncher(tmp_path / "submitit", cluster="local", jobs=1)
  caught: list[int] = []
  log = tmp_path / "a.log"

  def show() -> None:
    if log.exists() and log.read_text():
      caught.append(signal.SIGHUP)

  Runner(sweep, launcher, lambda _: None).run(caught, show)
  first, second = load_manifest(tmp_path).runs
  assert (first.state, second.state) == (RUNNING, WAITING)
  os.kill(int(first.job), signal.SIGTERM)  # It still runs.
  while "saved" not in log.read_text():
    time.sleep(0.05)


def test_a_job_that_has_just_ended_can_be_stopped(tmp_path, monkeypatch):
  pytest.importorskip("submitit")
  monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
  sweep = sweep_of(tmp_path, "")
  launcher = SlurmLauncher(tmp_path / "submitit", cluster="local")
  job = launcher.start(sweep.work(sweep.runs[0]))
  while (code := job.poll()) is None:
    time.sleep(0.05)
  job.stop()
  assert code == 0


SLURM = {
  "srun": "",
  "sbatch": 'echo "Submitted batch job 17"; echo PENDING > state',
  "sacct": 'echo "JobID|State|NodeList"; echo "17|$(cat state)|"',
  "scancel": 'echo "CANCELLED by 0" > state',  # codespell:ignore
}
"""Commands of a cluster whose queue does not move."""


def test_a_job_that_is_canceled_in_the_queue_has_been_stopped(tmp_path, monkeypatch):
  pytest.importorskip("submitit")
  monkeypatch.chdir(tmp_path)
  monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
  for name, lines in SLURM.items():
    (tmp_path / name).write_text(f"#!/bin/sh\ncd {tmp_path}\n{lines}\n")
    (tmp_path / name).chmod(0o755)
  sweep = sweep_of(tmp_path, "")
  Runner(sweep, SlurmLauncher(tmp_path / "submitit"), lambda _: None).run(
    caught := [], lambda: caught.append(signal.SIGINT)
  )
  (entry,) = load_manifest(tmp_path).runs
  assert (entry.state, entry.code) == (STOPPED, 143)
  assert "job 17" in entry.line


def test_a_run_that_is_stopped_as_it_starts_has_not_failed(tmp_path):
  sweep = sweep_of(tmp_path, "import time; time.sleep(60)")
  caught: list[int] = []
  run(sweep, caught=caught, show=lambda: caught.append(signal.SIGINT))
  assert (sweep.runs[0].state, sweep.runs[0].code) == (STOPPED, -signal.SIGTERM)


def test_two_processes_cannot_run_one_sweep(tmp_path):
  sweep = sweep_of(tmp_path, "")
  with run_folder.lock(tmp_path), pytest.raises(FileError, match="another process"):
    run(sweep)
  assert not (tmp_path / MANIFEST_FILE).exists()


def test_progress_is_read_while_it_is_written(tmp_path):
  folder = make_run(tmp_path / "a", [0.1, 0.4, 0.6], minutes=1.0)
  path = folder / "metrics.jsonl"
  text = path.read_text()
  half = text.index("\n", text.index('"step": 2000')) + 10
  path.write_text(text[:half])
  follower = Follower(folder)
  follower.update()
  assert (follower.step, follower.success) == (2000, 0.1)
  assert follower.share == pytest.approx(2 / 3)
  assert follower.left_s == pytest.approx(60)
  path.write_text(text)
  follower.update()
  assert (follower.step, follower.success, follower.left_s) == (3000, 0.6, 0)
  path.write_text(text[:half])  # A resume cuts off what came after its checkpoint.
  follower.update()
  assert follower.step == 2000


def display_of(folder: Path, stream: io.StringIO) -> SweepDisplay:
  make_run(folder / "b", [0.25, 0.5], finished=False)
  sweep = sweep_of(folder, "", "", "")
  sweep.runs[1].state = RUNNING
  sweep.runs[2].state, sweep.runs[2].line = FAILED, "apnpql: disk full"
  ticks = iter(range(0, 10_000, 100))
  return SweepDisplay(sweep, stream=stream, clock=lambda: next(ticks))


def test_without_a_terminal_there_are_plain_lines(tmp_path):
  stream = io.StringIO()
  with display_of(tmp_path, stream) as display:
    display.show()
    display.report(display._manifest.runs[2])
  assert stream.getvalue() == (
    "1 running, 1 failed, 1 waiting; b 100 %\nfailed c: apnpql: disk full\n"
  )


class Terminal(io.StringIO):
  """A stream that claims to be a terminal."""

  def isatty(self) -> bool:
    """Returns True."""
    return True


@pytest.mark.parametrize("columns", [40, 100])
def test_on_a_terminal_there_is_a_table(columns, tmp_path, monkeypatch):
  monkeypatch.setenv("COLUMNS", str(columns))
  monkeypatch.setenv("TERM", "xterm")
  stream = Terminal()
  with display_of(tmp_path, stream) as display:
    display.show()
    table = display._table()
  assert "\x1b[?25h" in stream.getvalue()  # The cursor is back.
  text = io.StringIO()
  Console(file=text, width=columns).print(table)
  lines = text.getvalue().splitlines()
  assert max(map(len, lines)) <= columns
  (row,) = [line for line in lines if "running" in line and line.split()[0] == "b"]
  assert "50 %" in row and "100 %" in row


def test_a_full_disk_costs_only_the_manifest(tmp_path, monkeypatch, capfd):
  sweep = sweep_of(tmp_path, "", "")
  saved = []

  def save() -> None:
    saved.append(1)
    if len(saved) > 1:
      raise OSError(errno.ENOSPC, "No space left on device")

  monkeypatch.setattr(sweep, "save", save)
  assert run(sweep) == ["a", "b"]
  assert [entry.state for entry in sweep.runs] == ["done", "done"]
  assert "cannot save the manifest: [Errno 28] No space left" in capfd.readouterr().err


@pytest.mark.parametrize("devices", [["--devices", "4"], ["--devices=4"]])
def test_a_run_that_has_begun_is_resumed_with_what_it_does_not_store(
  devices, tmp_path: Path
):
  work = Work("a", ["./mine.py", *devices, "--seed", "1"], tmp_path, tmp_path / "log")
  assert work.command()[3:] == ["train", *work.argv, "--run", str(tmp_path)]
  (tmp_path / run_folder.CONFIG_FILE).touch()
  resumed = ["train", "--resume", str(tmp_path), "--task-file", "./mine.py"]
  assert work.command()[3:] == [*resumed, "--devices", "4"]
  named = work._replace(argv=["push_plate"])
  assert named.command()[3:] == resumed[:3]
  both = work._replace(argv=["./mine.py", "--task-file", "task.py"])
  assert both.command()[3:] == [*resumed[:4], "task.py"]
