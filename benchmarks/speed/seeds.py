"""Updates per second of two seeds: two pinned processes, or one program for both.

  python -m benchmarks.speed.seeds --store

"processes" are two processes on half of the cores each, as `apnpql sweep --jobs 2`
starts them, with one seed each. "batched" is one process on all cores whose update is
vmapped over two seeds. Each takes turns with the other; figures are updates of both
seeds together.
"""

import argparse
from collections.abc import Iterator
import dataclasses
import functools
import os
import statistics
import subprocess
import sys
import time
from typing import IO, Any

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.sweeps.local import available_cores, shares
from benchmarks.common import command, noise, settings, store, timing
from benchmarks.speed.learner import nth_update

SEEDS = 2
Result = dict[str, Any]


def main() -> None:
  parser = command.parser(__doc__, repeats=5)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--obs", nargs="+", default=["pixels", "state"])
  parser.add_argument("--seconds", type=float, default=10.0, help="of a repeat")
  parser.add_argument("--worker", type=int, help="seeds of this process; internal")
  args = command.parse(parser)
  args.seconds = 0.5 if args.quick else args.seconds
  if args.worker:
    serve(args)
  else:
    command.publish("seeds", args, measure_all(args), preset=args.preset, seeds=SEEDS)


def measure_all(args: argparse.Namespace) -> Iterator[Result]:
  """Yields the rates of both ways for each kind of observation."""
  for obs in args.obs:
    rates = measure(args, obs)
    for way, found in rates.items():
      yield {"obs": obs, "way": way, **timing.spread("updates_per_s", found)}
    pairs = zip(rates["batched"], rates["processes"], strict=True)
    ratio = statistics.median(batched / apart for batched, apart in pairs)
    yield {"obs": obs, "way": "batched / processes", "ratio": ratio}


def measure(args: argparse.Namespace, obs: str) -> dict[str, list[float]]:
  """Returns the updates per second of both ways in every repeat."""
  cores = available_cores()
  halves = [Worker(args, obs, 1, share) for share in shares(cores, SEEDS)]
  ways = {"processes": halves, "batched": [Worker(args, obs, SEEDS, cores)]}
  rates: dict[str, list[float]] = {way: [] for way in ways}
  for workers in ways.values():
    for worker in workers:
      worker.answer()  # Compiled.
  for _ in range(args.repeats):
    for way, workers in ways.items():
      for worker in workers:
        worker.ask()
      rates[way].append(sum(worker.answer() for worker in workers))
  for worker in sum(ways.values(), []):
    worker.close()
  return rates


class Worker:
  """A process that updates some seeds on some cores when asked to."""

  def __init__(self, args: argparse.Namespace, obs: str, seeds: int, cores: list[int]):
    """Starts the process, which compiles."""
    options = ["--worker", str(seeds), "--obs", obs, "--preset", args.preset]
    options += ["--seconds", str(args.seconds), *(["--quick"] * args.quick)]
    self._process = subprocess.Popen(
      [sys.executable, "-m", "benchmarks.speed.seeds", *options],
      cwd=store.ROOT,
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      text=True,
    )
    if cores:
      os.sched_setaffinity(self._process.pid, cores)

  def ask(self) -> None:
    """Asks for one repeat."""
    _of(self._process.stdin).write("go\n")
    _of(self._process.stdin).flush()

  def answer(self) -> float:
    """Waits for the updates per second of a repeat; 0 after compiling."""
    return float(_of(self._process.stdout).readline())

  def close(self) -> None:
    """Ends the process."""
    _of(self._process.stdin).close()
    self._process.wait()


def serve(args: argparse.Namespace) -> None:
  """Compiles updates of ``args.worker`` seeds, then runs them at each line of input."""
  seeds = args.worker
  config = settings.preset(args.preset, quick=args.quick)
  config = settings.changed(config, "env", obs=args.obs[0])
  agent = make_agent(dataclasses.replace(config.agent, m_step_delay=0))
  one = noise.transitions(config)
  keys = jax.random.split(jax.random.key(0), seeds)
  batch = jax.tree.map(lambda x: jnp.stack([x] * seeds), one)
  states = jax.vmap(lambda key: agent.init(key, one.observation_tm1))(keys)

  def updates(state: Any, batch: Any) -> Any:
    step = functools.partial(nth_update, agent, batch)
    return jax.lax.fori_loop(0, 16, step, state)

  if seeds == 1:  # Not even a batch of one seed.
    states, batch = (jax.tree.map(lambda x: x[0], x) for x in (states, batch))
    program = jax.jit(updates)
  else:
    program = jax.jit(jax.vmap(updates))
  states = jax.block_until_ready(program(states, batch))
  print(0.0, flush=True)
  for _ in sys.stdin:
    began, count = time.perf_counter(), 0
    while (seconds := time.perf_counter() - began) < args.seconds:
      states = jax.block_until_ready(program(states, batch))
      count += 16 * seeds
    print(count / seconds, flush=True)


def _of(stream: IO[str] | None) -> IO[str]:
  assert stream is not None
  return stream


if __name__ == "__main__":
  main()
