"""Processes that measure on request, so that both sides of a comparison take turns.

A side is a module of this folder. Its function ``build(settings)`` returns its measures
and facts about it. Each side waits while the other one works, and a disturbance of the
machine affects both.
"""

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

Settings = Mapping[str, Any]
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


class Side(contextlib.AbstractContextManager):
  """A running side; leaving the context ends all its processes."""

  def __init__(
    self, module: str, settings: Settings, *, count: int = 1, limit_s: float, **env: str
  ):
    """Starts ``count`` processes of a module of this folder and waits for them.

    Each gets the settings with its number as "seed", and the variables ``env``. Their
    rates are added up. Raises ``SideFailed`` if one ends, or is silent for ``limit_s``.
    """
    self._limit_s, self._errors = limit_s, tempfile.TemporaryFile("w+")
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "benchmarks.peers.sides", module]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    pipes |= {"stderr": self._errors, "text": True, "start_new_session": True}
    pipes |= {"env": os.environ | {"PYTHONPATH": path} | env}
    inputs = [json.dumps({**settings, "seed": seed}) for seed in range(count)]
    self._processes = [subprocess.Popen([*command, x], **pipes) for x in inputs]
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
    answers = list(map(self._answer, self._processes))  # Of all, even after an error.
    late.cancel()
    for answer in answers:
      if "error" in answer:
        raise SideFailed(answer["error"])
    return answers

  def _answer(self, process: subprocess.Popen) -> dict[str, Any]:
    assert process.stdout is not None
    if line := process.stdout.readline():
      return json.loads(line)
    if process.wait() == -signal.SIGKILL:
      return {"error": f"no answer within {self._limit_s:.0f} s"}
    self._errors.seek(0)
    lines = self._errors.read().strip().splitlines()
    return {"error": lines[-1] if lines else f"exit code {process.returncode}"}

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
