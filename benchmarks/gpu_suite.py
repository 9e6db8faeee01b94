"""All that is worth knowing on a GPU, in one call under 8 minutes, as one JSON file.

  python benchmarks/gpu_suite.py --out gpu.json --wheels wheels
  python benchmarks/gpu_suite.py --out quick.json --quick        # tiny, on a CPU
  python benchmarks/gpu_suite.py --store gpu.json   # keeps it, and its table in docs/

Engines (MJX with and without its cures, Warp), layouts of the ray caster, precision of
matrix products, 256 to 8,192 worlds of each task, policy and learner, compilation,
memory, and three minutes of training. Each section is a process of its own; the file is
written anew after every figure, and what no longer fits into the budget is named in it.
Needs a checkout and no network: what is not installed is taken from ``--wheels``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
import contextlib
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

FOLDER = Path(__file__).resolve().parent
SCRIPT = FOLDER / "gpu_sections.py"
CORES = os.cpu_count() or 1
AFTER_TRAINING_S = 30.0
"""Kept for the episodes that are played after training."""

FULL: dict[str, Any] = {
  "seconds": 0.5,
  "repeats": 3,
  "backend": "mjx",
  "matrix": 8192,
  "engines": [
    "jax, cones",
    "jax, cones, all contacts",
    "jax, barrier and cones",
    "jax, barrier",
    "jax, stock",
    "jax, cones, TF32",
    "warp",
  ],
  "engine_worlds": 1024,
  "substeps": 30,
  "render_worlds": 1024,
  "layouts": ["fold, 4 blocks", "fold, 1 block", "fold, 16 blocks", "types at once"],
  "batches": [64, 512],
  "candidates": 120,
  "updates": 8,
  "worlds": [256, 1024, 4096, 8192],
  "bank_rows": 2048,
  "rate_worlds": 1024,
  "train_worlds": 512,
  "train_batch": 512,
  "replay_periods": 400,
  "expert_periods": 100,
  "eval_episodes": 64,
}
QUICK: dict[str, Any] = FULL | {
  "seconds": 0.01,
  "repeats": 1,
  "backend": "auto",
  "matrix": 64,
  # The others take minutes to compile on a CPU.
  "engines": ["jax, barrier and cones", "warp"],
  "engine_worlds": 2,
  "substeps": 1,
  "render_worlds": 2,
  "layouts": ["fold, 4 blocks", "types at once"],
  "batches": [4],
  "candidates": 4,
  "updates": 1,
  "worlds": [2],
  "bank_rows": 128,
  "rate_worlds": 2,
  "train_worlds": 2,
  "train_batch": 4,
  "replay_periods": 20,
  "expert_periods": 20,
  "eval_episodes": 2,
}
TASKS = ("push_plate", "stack_box", "flip_cup", "place_plate")
SECTIONS = (
  *("device", "engines", "raycaster", "learner", "rates"),
  *(f"worlds/{task}" for task in TASKS),
  "train",
)


class Report:
  """The JSON file; every change is on the disk before the next."""

  def __init__(self, path: Path, **header: Any):
    self._path, self._lock = path, threading.Lock()
    self.content: dict[str, Any] = {"benchmark": "gpu_suite", **header, "sections": {}}

  def put(self, section: str, **fields: Any) -> None:
    """Sets fields of a section; a ``result`` joins its results."""
    with self._lock:
      entry = self.content["sections"].setdefault(section, {"results": []})
      if (result := fields.pop("result", None)) is not None:
        entry["results"].append(result)
      entry.update(fields)
      beside = self._path.with_suffix(".part")
      beside.write_text(json.dumps(self.content, indent=2, default=str) + "\n")
      beside.replace(self._path)


class Running:
  """A section at work; its lines go into the report as they come."""

  def __init__(self, name: str, settings: dict[str, Any], env: dict, report: Report):
    self.name, self._report, self._began = name, report, time.time()
    section, _, task = name.partition("/")
    self._said = tempfile.TemporaryFile()
    self._process = subprocess.Popen(
      [sys.executable, str(SCRIPT), section, json.dumps(settings | {"task": task})],
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      stderr=self._said,
      env=env,
      start_new_session=True,
    )
    report.put(name, status="running")
    self._reader = threading.Thread(target=self._read)
    self._reader.start()

  def go(self, **terms: float) -> None:
    """Lets a section that waits for it begin, on these terms."""
    assert self._process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
      self._process.stdin.write(f"{json.dumps(terms)}\n".encode())
      self._process.stdin.flush()

  @property
  def over(self) -> bool:
    """Whether it has ended."""
    return self._process.poll() is not None

  def kill(self) -> None:
    """Ends it, with all that it has started."""
    with contextlib.suppress(ProcessLookupError):
      os.killpg(self._process.pid, signal.SIGKILL)

  def finish(self, deadline: float) -> None:
    """Waits until it ends, or ends it, and says in the report how it went."""
    status = "done"
    try:
      self._process.wait(max(0.0, deadline - time.time()))
    except subprocess.TimeoutExpired:
      status = "stopped: its time was over"
      self.kill()
    self._reader.join()
    if status == "done" and self._process.wait():
      self._said.seek(0)
      said = self._said.read().decode(errors="replace").strip().splitlines()
      status = f"failed: {said[-1] if said else self._process.returncode}"
    entry = self._report.content["sections"][self.name]
    there = {result["what"] for result in entry["results"]}
    missing = [what for what in entry.get("plan", []) if what not in there]
    seconds = time.time() - self._began
    self._report.put(self.name, status=status, missing=missing, seconds=seconds)
    print(f"{self.name}: {status}, {len(there)} figures", flush=True)

  def _read(self) -> None:
    assert self._process.stdout is not None
    for line in self._process.stdout:
      # Libraries print, too; and a process that is ended leaves half a line.
      with contextlib.suppress(ValueError):
        said = json.loads(line)
        if isinstance(said, dict) and said.keys() & {"plan", "what"}:
          new = {"plan": said["plan"]} if "plan" in said else {"result": said}
          self._report.put(self.name, **new)


def main(argv: Sequence[str] | None = None) -> None:
  """Command line; see the module's docstring."""
  args = _arguments(argv)
  if args.store:
    store(args.store)
    return
  began = time.time()
  folder = Path(tempfile.mkdtemp(prefix="gpu_suite_"))
  try:
    report = Report(args.out, commit=_commit(), arguments=vars(args))
    env = _environment(args, folder)
    if problem := _prepare(args.wheels, folder, env):
      report.put("prepare", status=f"failed: {problem}")
      sys.exit(problem)
    report.put("prepare", status="done", seconds=time.time() - began)
    _run_all(args, folder, env, report, end=began + args.budget)
    report.put("suite", status="done", seconds=time.time() - began)
  finally:
    shutil.rmtree(folder, ignore_errors=True)


def store(path: Path) -> None:
  """Keeps a report in ``benchmarks/results``; ``report.py`` makes the table of it."""
  import tables  # Needs what may have to be taken from the wheels elsewhere.

  report = json.loads(path.read_text())
  if report["arguments"]["quick"]:
    sys.exit("--quick figures mean nothing; nothing is stored")
  tables.store("gpu_suite", report)


def rows(report: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
  """A line for every figure, and for what there is none of."""
  for name, entry in report["sections"].items():
    for result in entry["results"]:
      note = "; ".join(_notes(result))
      unit = next((key for key in result if key.endswith("_per_s")), None)
      figure = (unit.removesuffix("_per_s"), result[unit]) if unit else ("", "")
      size = result.get("program_gib", "")
      compile_s = result.get("compile_s", "")
      yield name, result["what"], figure[1], figure[0], compile_s, size, note
    for what in entry.get("missing", ()):
      yield name, what, "", "", "", "", entry["status"]
    if not entry["results"] and entry.get("status") != "done":
      yield name, "", "", "", "", "", entry.get("status", "")


def _notes(result: dict[str, Any]) -> Iterator[str]:
  if "error" in result:
    yield result["error"]
  if not result.get("quiet", True):
    yield "others compiled"
  if "success_rate" in result:
    yield f"{100 * result['success_rate']:.0f} % of episodes solved"
  if "qpos_differs" in result:
    yield f"{result['qpos_differs']:.2g} m or rad from C MuJoCo"
  if "peak_gib" in result:
    yield f"process {result['peak_gib']:.2g} GiB"


def _run_all(
  args: argparse.Namespace, folder: Path, env: dict, report: Report, *, end: float
) -> None:
  """Measures as many sections at once as there are jobs; then trains."""
  names = [name for name in args.sections if name != "train"]
  training = "train" in args.sections
  tail = AFTER_TRAINING_S + args.train if training else 0.0
  measured = end - tail
  settings = (QUICK if args.quick else FULL) | {
    "folder": str(folder),
    # Twice as many programs at once as cores: much of a compilation is tracing.
    "threads": max(1, 2 * CORES // min(args.jobs, len(args.sections))),
    # Half of the time may pass in waiting for others to compile.
    "compile_until": (time.time() + measured) / 2,
  }

  def start(name: str) -> Running:
    return Running(name, settings, env, report)

  # It compiles while the others do, where there are cores enough.
  trainer = start("train") if training and args.jobs > 1 else None
  running: list[Running] = []
  try:
    while (names or running) and time.time() < measured:
      while names and len(running) < args.jobs:
        running.append(start(names.pop(0)))
      for section in [section for section in running if section.over]:
        section.finish(measured)
        running.remove(section)
      time.sleep(0.05)
    for section in running:
      section.finish(measured)
    for name in names:
      report.put(name, status="skipped: no time was left")
      print(f"{name}: skipped", flush=True)
    if training:
      trainer = trainer or start("train")
      trainer.go(seconds=args.train, until=end - AFTER_TRAINING_S)
      trainer.finish(end)
  finally:
    for section in filter(None, [*running, trainer]):
      section.kill()


def _environment(args: argparse.Namespace, folder: Path) -> dict[str, str]:
  """The environment of the sections."""
  paths = [str(FOLDER.parent), str(folder / "site"), os.environ.get("PYTHONPATH", "")]
  env = os.environ | {
    "PYTHONPATH": os.pathsep.join(filter(None, paths)),
    # Sections share the device.
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    # Empty, so that compilation is what it is the first time.
    "JAX_COMPILATION_CACHE_DIR": str(folder / "xla"),
  }
  if args.quick:
    flags = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes"
    env["XLA_FLAGS"] = flags
  return env


def _prepare(wheels: Path | None, folder: Path, env: dict[str, str]) -> str | None:
  """Takes from the wheels what the sections need; returns what is wrong, or None."""
  problem = _imports(env)
  if problem is None or wheels is None:
    return problem
  command = [sys.executable, "-m", "pip", "install", "--no-index", "--no-deps"]
  files = sorted(map(str, wheels.glob("*.whl")))
  done = subprocess.run(
    [*command, "--no-compile", "--target", str(folder / "site"), *files],
    capture_output=True,
    text=True,
  )
  if done.returncode:
    return (done.stderr.strip().splitlines() or ["pip failed"])[-1]
  return _imports(env)


def _imports(env: dict[str, str]) -> str | None:
  """The last line of what the imports of the sections complain of."""
  done = subprocess.run(
    [sys.executable, str(SCRIPT)], env=env, capture_output=True, text=True
  )
  said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
  return said[-1] if done.returncode else None


def _commit() -> str:
  command = ["git", "rev-parse", "--short", "HEAD"]
  try:
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True)
  except OSError:  # No git.
    return ""
  return done.stdout.strip()


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--out", type=Path, default=Path("gpu_suite.json"))
  parser.add_argument("--store", type=Path, help="keep this report; measures nothing")
  parser.add_argument("--wheels", type=Path, help="folder of what is not installed")
  parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
  parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
  parser.add_argument("--budget", type=float, default=465.0, help="s for everything")
  parser.add_argument("--train", type=float, default=180.0, help="s of training")
  parser.add_argument(
    "--jobs",
    type=int,
    default=CORES,
    help="sections that compile at once; figures come one at a time",
  )
  args = parser.parse_args(argv)
  args.out = args.out.absolute()
  return args


if __name__ == "__main__":
  main()
