"""Processes that measure on request, so that both sides of a comparison take turns.

A side is a module of this folder. Its function ``build(settings)`` returns its measures
and facts about it. Each side waits while the other one works, and a disturbance of the
machine affects both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
import importlib
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

from apnpql_jax import runtime

ROOT = Path(__file__).resolve().parents[2]

Measure = Callable[[float], float]
"""Works for about so many seconds and returns a rate, 1/s."""

Built = tuple[dict[str, Measure], dict[str, Any]]


class SideFailed(Exception):
  """A side that is missing or gave no answer; the message is one line."""


def rate_of(run: Callable[[], Any], per_call: int) -> Measure:
  """Returns a measure that calls ``run``, which blocks until its units are done."""

  def measure(seconds: float) -> float:
    calls, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds or not calls:
      run()
      calls += 1
    return calls * per_call / spent

  return measure


def carried(step: Callable[[Any, int], Any], state: Any) -> Callable[[], None]:
  """Returns a function that advances a state: (state, number of calls) -> state."""
  calls = 0

  def run() -> None:
    nonlocal state, calls
    state, calls = step(state, calls), calls + 1

  return run


class Side(contextlib.AbstractContextManager):
  """A running side; leaving the context ends all its processes."""

  def __init__(
    self,
    module: str,
    settings: Mapping[str, Any],
    *,
    count: int = 1,
    env: Mapping[str, str] | None = None,
    limit_s: float,
  ):
    """Starts the processes and waits until they are ready.

    Args:
      module: of this folder.
      settings: what to build; each process also gets its number as "seed".
      count: processes, whose rates are added up.
      env: environment variables in addition to those of this process.
      limit_s: longest time to become ready, and for each answer, s.
    """
    self._limit_s, self._errors = limit_s, tempfile.TemporaryFile()
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "benchmarks.peers.sides", module]
    self._processes = [
      subprocess.Popen(
        [*command, json.dumps({**settings, "seed": seed})],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=self._errors,
        env=os.environ | {"PYTHONPATH": path} | dict(env or {}),
        start_new_session=True,
        text=True,
      )
      for seed in range(count)
    ]
    try:
      self.about = self._answers()[0]
    except SideFailed:
      self.__exit__()
      raise

  def rate(self, name: str, seconds: float) -> float:
    """Measures once; raises ``SideFailed`` without an answer."""
    for process in self._processes:
      assert process.stdin is not None
      with contextlib.suppress(BrokenPipeError):  # The missing answer explains it.
        process.stdin.write(f"{name} {seconds}\n")
        process.stdin.flush()
    return sum(answer["rate"] for answer in self._answers())

  def __exit__(self, *_: Any) -> None:
    self._kill()
    for process in self._processes:
      process.wait()

  def _answers(self) -> list[dict[str, Any]]:
    late = threading.Timer(self._limit_s, self._kill)
    late.start()
    try:
      return [self._answer(process) for process in self._processes]
    finally:
      late.cancel()

  def _answer(self, process: subprocess.Popen) -> dict[str, Any]:
    assert process.stdout is not None
    if line := process.stdout.readline():
      answer = json.loads(line)
    elif process.wait() == -signal.SIGKILL:
      answer = {"error": f"no answer within {self._limit_s:.0f} s"}
    else:
      self._errors.seek(0)
      lines = self._errors.read().decode(errors="replace").strip().splitlines()
      answer = {"error": (lines or [f"exit code {process.returncode}"])[-1]}
    if "error" in answer:
      raise SideFailed(answer["error"])
    return answer

  def _kill(self) -> None:
    for process in self._processes:
      with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def main() -> None:
  """Builds a side and answers every line "NAME SECONDS" with a line of JSON."""
  answers = os.fdopen(os.dup(1), "w")
  os.dup2(2, 1)  # Libraries print to standard output.
  runtime.configure()
  module, settings = sys.argv[1:]
  build = importlib.import_module(f"benchmarks.peers.{module}").build
  measures, answer = build(json.loads(settings))
  while True:
    print(json.dumps(answer), file=answers, flush=True)
    line = sys.stdin.readline()
    if not line:
      return
    name, seconds = line.split()
    try:
      answer = {"rate": measures[name](float(seconds))}
    except Exception as error:  # The next question may succeed.
      answer = {"error": f"{type(error).__name__}: {error}"}


if __name__ == "__main__":
  main()
