"""Processes that measure on request, so that what is compared is timed in turns.

A side is a script: it builds what it measures, says so with a line of JSON, and then
answers every line "NAME SECONDS" with a rate. Ours and theirs wait side by side, and
what disturbs the machine disturbs both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import contextlib
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

FOLDER = Path(__file__).resolve().parent

Measure = Callable[[float], float]
"""Works for about so many seconds and returns a rate, 1/s."""


class SideFailed(Exception):
  """A side is not there, or gave no answer; the one-line message says why."""


def rate_of(run: Callable[[], Any], per_call: int) -> Measure:
  """Calls ``run``, which blocks until its ``per_call`` units are done."""

  def measure(seconds: float) -> float:
    calls, began = 0, time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds or not calls:
      run()
      calls += 1
    return calls * per_call / spent

  return measure


def serve(measures: Mapping[str, Measure], **about: Any) -> None:
  """Answers on standard output until standard input ends."""
  print(json.dumps({"ready": sorted(measures), **about}), flush=True)
  for line in sys.stdin:
    name, seconds = line.split()
    try:
      answer: dict[str, Any] = {"rate": measures[name](float(seconds))}
    except Exception as error:  # The next question may fare better.
      answer = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(answer), flush=True)


class Side(contextlib.AbstractContextManager):
  """A side at work; leaving the context ends it with all its processes."""

  def __init__(
    self,
    script: str,
    settings: Mapping[str, Any],
    *,
    env: Mapping[str, str] | None = None,
    limit_s: float,
  ):
    """
    Args:
      script: in this folder; gets the settings as one JSON argument.
      settings: what to build.
      env: environment variables beside those of this process.
      limit_s: until it must be ready, and for each answer, s.

    Raises:
      SideFailed: it ends or stays silent instead of being ready.
    """
    self._limit_s = limit_s
    self._said = tempfile.TemporaryFile()
    root = os.pathsep.join([str(FOLDER.parent), os.environ.get("PYTHONPATH", "")])
    self._process = subprocess.Popen(
      [sys.executable, str(FOLDER / script), json.dumps(settings)],
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      stderr=self._said,
      env=os.environ | {"PYTHONPATH": root} | dict(env or {}),
      start_new_session=True,
    )
    try:
      self.about = self._answer("ready")
    except SideFailed:
      self.__exit__()
      raise

  def rate(self, name: str, seconds: float) -> float:
    """One measurement.

    Raises:
      SideFailed: the measurement did not succeed.
    """
    assert self._process.stdin is not None
    try:
      self._process.stdin.write(f"{name} {seconds}\n".encode())
      self._process.stdin.flush()
    except BrokenPipeError:
      pass  # The answer, or rather its absence, says more.
    answer = self._answer("rate", "error")
    if "error" in answer:
      raise SideFailed(answer["error"])
    return answer["rate"]

  def __exit__(self, *_: Any) -> None:
    _kill(self._process)
    self._process.wait()

  def _answer(self, *keys: str) -> dict[str, Any]:
    """The next line that is JSON with one of the keys; libraries print others."""
    assert self._process.stdout is not None
    late = threading.Timer(self._limit_s, _kill, [self._process])
    late.start()
    try:
      for line in self._process.stdout:
        with contextlib.suppress(ValueError):
          answer = json.loads(line)
          if isinstance(answer, dict) and any(key in answer for key in keys):
            return answer
    finally:
      late.cancel()
    raise SideFailed(self._last_words())

  def _last_words(self) -> str:
    self._said.seek(0)
    lines = self._said.read().decode(errors="replace").strip().splitlines()
    code = self._process.wait()
    if code == -signal.SIGKILL:
      return f"no answer within {self._limit_s:.0f} s"
    return lines[-1] if lines else f"exit code {code}"


def _kill(process: subprocess.Popen) -> None:
  with contextlib.suppress(ProcessLookupError):
    os.killpg(process.pid, signal.SIGKILL)
