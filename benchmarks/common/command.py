"""Command line and report of a benchmark.

A report is one JSON object: the machine, the settings, and a list of results. Without
``--json`` it is printed as it grows: a line with all but the results, then one line for
each result.
"""

import argparse
from collections.abc import Iterable, Sequence
import json
import os
import shlex
import sys
from typing import Any

import jax

from apnpql_jax import runtime, testing
from benchmarks.common import floor, store

PRECISIONS = ("highest", "tensorfloat32", "bfloat16")


def parser(doc: str | None, *, repeats: int | None = None) -> argparse.ArgumentParser:
  """Returns the common options; with ``repeats`` also those of timed benchmarks."""
  options = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
  flag = options.add_argument
  flag("--json", action="store_true", help="print one JSON object and nothing else")
  flag("--quick", action="store_true", help="tiny sizes, to see that it runs")
  flag("--store", action="store_true", help="keep the report in benchmarks/results")
  if repeats is not None:
    flag("--repeats", type=int, default=repeats, help="times that a figure is taken")
    flag("--precision", choices=PRECISIONS, default=PRECISIONS[0], help="of products")
  return options


def parse(
  options: argparse.ArgumentParser, argv: Sequence[str] | None = None
) -> argparse.Namespace:
  """Reads the command line and configures the process, before JAX computes anything.

  ``--quick`` also compiles without optimization.
  """
  args = options.parse_args(argv)
  args.options = shlex.join(sys.argv[1:] if argv is None else argv)
  if args.quick and args.store:
    options.error("--quick figures mean nothing; nothing is stored")
  if args.quick:
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} {testing.XLA_FLAGS}".lstrip()
  # Processes that a benchmark starts share the device with it.
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
  runtime.configure()
  if "precision" in args:
    args.repeats = 2 if args.quick else args.repeats
    jax.config.update("jax_default_matmul_precision", args.precision)
  return args


def publish(
  name: str, args: argparse.Namespace, results: Iterable[dict[str, Any]], **header: Any
) -> None:
  """Prints and stores results as they come, so that a crash costs only later ones.

  ``header`` holds the settings that all results share.
  """
  report: dict[str, Any] = {"benchmark": name, "options": args.options}
  report |= store.machine() | header
  if "precision" in args:
    peak = floor.machine_peak()._asdict()
    report |= {"peak": peak, "repeats": args.repeats, "precision": args.precision}
  if not args.json:
    print(json.dumps(report), flush=True)
  report = report | {"results": []}
  for result in results:
    report["results"].append(result | _device_memory())
    if not args.json:
      print(json.dumps(report["results"][-1]), flush=True)
    if args.store:
      store.store(name, report)
  if args.json:
    print(json.dumps(report))


def _device_memory() -> dict[str, float]:
  """Returns the most memory this process has held on the device; nothing on a CPU."""
  peak = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
  return {} if peak is None else {"peak_gib": peak / 2**30}
