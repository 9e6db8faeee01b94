"""The process in which the checks that need JAX run, and its end."""

from __future__ import annotations

from collections.abc import Callable
import multiprocessing
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
import os
from pathlib import Path
import signal
import tempfile

from apnpql_jax import runtime
from apnpql_jax.doctor import probes
from apnpql_jax.doctor.findings import Finding

TIMEOUT_S = 300.0
"""Longest time that one check may take."""

_XLA_FLAGS = (
  "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
)
"""Flags with which the programs of the self-test, which run once, compile fast."""


def examine(
  self_test: bool, tell: Callable[[str], None], *, timeout_s: float = TIMEOUT_S
) -> tuple[list[Finding], int | None]:
  """Runs the checks in a new process.

  Args:
    self_test: Whether to play episodes, draw and learn as well.
    tell: Is called with the name of each check that has ended.
    timeout_s: Longest time that one check may take.

  Returns:
    The findings, and the free bytes of the device, None for a CPU or if unknown.
  """
  context = multiprocessing.get_context("spawn")
  ours, theirs = context.Pipe(duplex=False)
  found: list[Finding] = []
  free: int | None = None
  with tempfile.TemporaryDirectory() as folder:
    log = Path(folder) / "log"
    process = context.Process(target=_work, args=(theirs, str(log), self_test))
    process.start()
    theirs.close()
    done = False
    try:
      while not done and ours.poll(timeout_s):
        message = ours.recv()
        if message == "done":
          done = True
        elif isinstance(message, list):
          found += message
          tell(", ".join(x.name for x in message))
        else:
          free = message
    except EOFError:
      process.join()
    if not done:
      found.append(_death(process, log, timeout_s))
    process.kill()
    process.join()
  return found, free


def _work(connection: Connection, log: str, self_test: bool) -> None:
  """Runs the checks; what libraries print goes to ``log``."""
  runtime.end_with_parent()
  descriptor = os.open(log, os.O_WRONLY | os.O_CREAT)
  os.dup2(descriptor, 1)
  os.dup2(descriptor, 2)
  if not probes.has_nvidia_gpu():
    os.environ.setdefault("XLA_FLAGS", _XLA_FLAGS)
  probes.run(connection.send, self_test)
  connection.send("done")


def _death(process: BaseProcess, log: Path, timeout_s: float) -> Finding:
  """Returns why the process did not finish."""
  if process.exitcode is None:
    reason = f"no answer within {timeout_s:.0f} s"
  elif process.exitcode < 0:
    reason = f"killed by {signal.Signals(-process.exitcode).name}"
  else:
    reason = f"ended with code {process.exitcode}"
  lines = log.read_text(errors="replace").split("\n") if log.exists() else []
  last = next((line.strip() for line in reversed(lines) if line.strip()), "")
  cure = "mend the installation of JAX or MuJoCo; if it ran out of memory, free some"
  text = f"{reason}: {last[:200]}" if last else reason
  return Finding("devices", "check", text, cure, broken=True)
