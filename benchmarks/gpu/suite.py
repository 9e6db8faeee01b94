"""Benchmarks of a GPU in one call of at most 6 minutes, as one JSON file.

  python -m benchmarks.gpu.suite --out gpu.json
  python -m benchmarks.gpu.suite --quick      # tiny sizes, also on a CPU
  python -m benchmarks.gpu.suite --store      # keeps it for docs/performance.md

Runs a short training from pixels and then the ordinary benchmarks, in the order of
``SECTIONS``. Several compile at the same time, but only one measures, while nobody
compiles. The file is complete after every result. A section that fails or exceeds the
budget keeps its earlier results, and its status holds the reason.
"""

from collections.abc import Sequence
import concurrent.futures
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

from apnpql_jax import runtime
from benchmarks.common import command, store, turns

_UPDATES = "speed.learner --batch 64 512 --candidates 120 --phi once"
SECTIONS = {
  "training from pixels": "gpu.training",
  "env_steps": "speed.env_steps --backends mjx --tasks push_plate --worlds 1024 4096",
  "learner": _UPDATES,
  "end_to_end": "speed.end_to_end --backends mjx --tasks push_plate --worlds 512",
  "render": "speed.render --alone --resolutions paper --batch 64 1024 --shadow 1024",
  "engines": "speed.engines --worlds 1024",
  "learner, TF32": f"{_UPDATES} --precision tensorfloat32",
  "env_steps, other tasks": "speed.env_steps --backends mjx --worlds 1024 "
  "--tasks stack_box flip_cup place_plate",
  "ray_layouts": "speed.ray_layouts --batch 1024",
  "env_steps, 8192 worlds": "speed.env_steps --backends mjx --tasks push_plate "
  "--worlds 8192",
}
"""Name -> benchmark and its arguments, the most important first."""


def main(argv: Sequence[str] | None = None) -> None:
  began = time.monotonic()
  parser = command.parser(__doc__)
  flag = parser.add_argument
  flag("--out", type=Path, default=Path("gpu.json"), help="file of the report")
  flag("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
  flag("--budget", type=float, default=350.0, help="s for everything")
  jobs = max(1, runtime.cores() // 4)
  flag("--jobs", type=int, default=jobs, help="sections that compile at once")
  args = command.parse(parser, argv)
  out = store.RESULTS / "gpu.json" if args.store else args.out
  with tempfile.TemporaryDirectory() as folder:
    suite = Suite(out, folder, began + args.budget)
    with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
      options = " --quick" if args.quick else ""
      commands = [f"{SECTIONS[name]}{options}".split() for name in args.sections]
      for line in pool.map(suite.run, args.sections, commands):
        if not args.json:  # In order of importance, not of time.
          print(line, flush=True)
  if args.json:
    print(json.dumps(suite.report))


class Suite:
  """Sections at work, and their common report."""

  def __init__(self, out: Path, folder: str, deadline: float):
    """Starts a report in ``out``; ``turns`` locks files in ``folder``."""
    self.report: dict[str, Any] = {"commit": store.commit(), "sections": {}}
    self._out, self._deadline, self._lock = out, deadline, threading.Lock()
    self._env = os.environ | {"PYTHONPATH": str(store.ROOT), turns.FOLDER: folder}

  def run(self, name: str, args: Sequence[str]) -> str:
    """Runs a benchmark until its end or the deadline; returns a line about its end."""
    began = time.monotonic()
    command, results = ["-m", f"benchmarks.{args[0]}", *args[1:]], []
    report = {"command": " ".join(command[1:]), "results": results}
    section: dict[str, Any] = {"report": report}
    self._put(name, section)
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "text": True}
    pipes |= {"env": self._env, "start_new_session": True}
    with tempfile.TemporaryFile("w+") as errors:
      process = subprocess.Popen([sys.executable, *command], stderr=errors, **pipes)
      late = threading.Timer(self._deadline - began, _kill, [process])
      late.start()
      for line in process.stdout or ():
        with contextlib.suppress(ValueError, TypeError):  # Libraries print, too.
          found = dict(json.loads(line))
          if "benchmark" in found:
            report |= found
          else:
            results.append(found)
          self._put(name, section)
      code = process.wait()
      late.cancel()
      errors.seek(0)
      lines = errors.read().strip().splitlines()
    ended = time.monotonic()
    section["status"] = "done"
    if code:
      reason = f"failed: {lines[-1] if lines else code}"
      section["status"] = "out of time" if ended >= self._deadline else reason
    section["seconds"] = ended - began
    self._put(name, section)
    return f"{name}: {section['status']}, {len(results)} results {results[-1:]}"

  def _put(self, name: str, section: dict[str, Any]) -> None:
    with self._lock:
      self.report["sections"][name] = section
      store.write(self._out, self.report)


def _kill(process: subprocess.Popen) -> None:
  with contextlib.suppress(ProcessLookupError):
    os.killpg(process.pid, signal.SIGKILL)


if __name__ == "__main__":
  main()
