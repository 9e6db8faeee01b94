"""What a signal does to a process whose main thread is in one long call."""

from __future__ import annotations

from collections.abc import Generator
import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from apnpql_jax.runs.signals import Signals

BUSY = """
import hashlib, sys
from apnpql_jax.cli import main
from apnpql_jax.cli.commands import COMMANDS, OPTIONS
from apnpql_jax.runs.signals import Signals

def busy(*_):
  print("ready", flush=True)
  hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)  # As deaf as a compilation.

def train(*_):
  with Signals("nothing is saved") as signals:
    if sys.argv[1] == "training":
      signals.finish_first("saving", "stopped at once")
    busy()

command = busy if sys.argv[1] == "listing" else train
COMMANDS["list"] = (OPTIONS["list"], command)
main.main(["list"])
"""


BUILDING = """
import contextlib, pathlib, sys, time
from apnpql_jax.runs import run_folder
from apnpql_jax.runs.signals import Signals
root, work = pathlib.Path(sys.argv[1]), sys.argv[2]
with Signals("nothing is saved"), run_folder.new_run_dir("a", root) as run:
  with run_folder.reserve(root / "b"):
    if work == "made":
      (run / "config.json").write_text("{}")
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def _hears_hangups() -> Generator[None]:
  """Undoes a ``nohup`` of the tests, which their processes would inherit."""
  before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
  yield
  signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize(("work", "left"), [("none", []), ("made", ["a-1"])])
def test_a_process_that_ends_at_once_leaves_no_empty_run_folder(tmp_path, work, left):
  command = [sys.executable, "-c", BUILDING, str(tmp_path), work]
  with subprocess.Popen(
    command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, text=True
  ) as process:
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 128 + signal.SIGINT
  assert [path.name for path in tmp_path.iterdir()] == left


def _busy(phase: str, *through: str) -> subprocess.Popen[str]:
  process = subprocess.Popen(
    [*through, sys.executable, "-c", BUSY, phase],
    cwd=Path(__file__).parents[2],
    stdin=subprocess.DEVNULL,
    stdout=subprocess.PIPE,
    stderr=subprocess.STDOUT,
    text=True,
  )
  assert process.stdout is not None and process.stdout.readline() == "ready\n"
  return process


def _printed(process: subprocess.Popen[str]) -> list[str]:
  assert process.stdout is not None
  return process.stdout.read().splitlines()


@pytest.mark.parametrize(
  ("phase", "number", "words"),
  [
    ("compiling", signal.SIGINT, "nothing is saved"),
    ("compiling", signal.SIGTERM, "nothing is saved"),
    ("compiling", signal.SIGHUP, "nothing is saved"),
    ("listing", signal.SIGINT, "interrupted"),
  ],
)
def test_with_nothing_to_save_the_first_signal_ends_the_process(phase, number, words):
  with _busy(phase) as process:
    process.send_signal(number)
    assert process.wait(10) == 128 + number
    assert _printed(process) == [f"apnpql: {words}"]


def test_with_nohup_a_closed_terminal_stops_nothing():
  with _busy("compiling", "nohup") as process:
    process.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
      process.wait(1.5)
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 128 + signal.SIGTERM


def test_a_second_signal_does_not_wait_but_one_sent_twice_is_one():
  with _busy("training") as process:
    process.send_signal(signal.SIGTERM)
    assert process.stdout is not None
    assert process.stdout.readline() == "saving; once more to stop at once\n"
    process.send_signal(signal.SIGTERM)  # As `timeout` does.
    with pytest.raises(subprocess.TimeoutExpired):
      process.wait(1.5)
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 128 + signal.SIGINT
    assert _printed(process) == ["apnpql: stopped at once"]


STOPPED = """
from apnpql_jax import errors
from apnpql_jax.cli import main
from apnpql_jax.cli.commands import COMMANDS, OPTIONS

def stop(*_):
  raise errors.RunStopped("no space left", errors.FAILED)

COMMANDS["list"] = (OPTIONS["list"], stop)
main.main(["list"])
"""


def test_the_exit_code_is_right_even_if_no_line_can_be_written():
  with open("/dev/full", "w") as full:  # As standard error on the disk that is full.
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", STOPPED]
    done = subprocess.run(command, cwd=root, stderr=full, timeout=60)
  assert done.returncode == 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_are_collected_and_given_back(number, capfd):
  before = signal.getsignal(number)
  with Signals("") as signals:
    signals.finish_first("", "")
    os.kill(os.getpid(), number)
    assert signals.caught == [number]
  assert signal.getsignal(number) == before
  assert signal.set_wakeup_fd(-1) == -1
