"""Updates per second of the learner, by batch and candidates.

  python benchmarks/learner.py --quick
  python benchmarks/learner.py --store    # keeps the table in docs/performance.md

The agent is that of a preset, its transitions are noise. The features phi of a state
are computed once and serve all candidate actions; "repeated" is the same learner that
looks at the images again for each of them, which is what the paper saves. Compilation
is timed apart; each figure is the median over repeats, with the lowest and the highest.
``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import dataclasses
import itertools
import json
import statistics
import sys
import time
from typing import Any
from unittest import mock

import apnpql_jax  # noqa: F401  isort: skip  (before JAX: sets threads and cache)
import jax
import jax.numpy as jnp
import tables

from apnpql_jax.agents import learner
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.agents.networks import Heads, Networks, Params, make_networks
from apnpql_jax.config import AgentConfig
from apnpql_jax.presets import load_preset
from apnpql_jax.types import Array, Observation

sys.path.append(str(tables.ROOT / "tests"))
from batches import random_batch  # noqa: E402  (the noise that the tests use)

SECONDS = 2.0  # of work per repeat


def main() -> None:
  """Command line; see the module's docstring."""
  parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
  parser.add_argument("--json", action="store_true", help="print one JSON object")
  parser.add_argument("--quick", action="store_true", help="few settings and repeats")
  parser.add_argument("--store", action="store_true", help="keep JSON and table")
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, nargs="+", default=[32, 64, 128])
  parser.add_argument("--candidates", type=int, nargs="+", default=[30, 120])
  parser.add_argument("--repeats", type=int, default=5)
  args = parser.parse_args()
  if args.quick:
    args.batch, args.candidates, args.repeats = [16], [8], 2
  config = load_preset(args.preset).agent
  report = {
    "benchmark": "learner",
    "preset": args.preset,
    **tables.machine(),
    "repeats": args.repeats,
    "results": [],
  }
  for result in measure_all(config, args):
    report["results"].append(result)
    if not args.json:
      print(result, flush=True)
  if args.json:
    print(json.dumps(report))
  if args.store:
    tables.store("learner", report)
    write(report)


def measure_all(config: AgentConfig, args: argparse.Namespace) -> Iterator[dict]:
  """Figures of every setting, one after the other."""
  for batch, candidates in itertools.product(args.batch, args.candidates):
    sized = dataclasses.replace(
      config,
      target_samples=candidates,
      policy_samples=candidates,
      # Epsilon must stay below the log of the candidates; it costs no time.
      epsilon=min(config.epsilon, 1.0),
    )
    for phi, build in (("once", make_agent), ("repeated", forgetful_agent)):
      figures = measure(build(sized), batch, args.repeats)
      yield {"batch": batch, "candidates": candidates, "phi": phi, **figures}


def measure(agent: Agent, batch: int, repeats: int) -> dict[str, Any]:
  """Compiles and times updates in a scan, where training has them."""
  transitions = random_batch(0, batch, pixels=True)
  state = agent.init(jax.random.key(0), transitions.observation_tm1)

  def updates(state, key, count: int):
    def one(state, key):
      state, metrics = agent.update(state, transitions, key)
      return state, metrics["loss/q"]

    return jax.lax.scan(one, state, jax.random.split(key, count))

  began = time.perf_counter()
  first = _compile(updates, state, 1)
  compile_s = time.perf_counter() - began
  seconds = min(_time(first, state) for _ in range(2))
  count = max(1, round(SECONDS / seconds))
  many = first if count == 1 else _compile(updates, state, count)
  rates = [count / _time(many, state) for _ in range(repeats)]
  return {
    "updates_per_s": statistics.median(rates),
    "updates_per_s_low": min(rates),
    "updates_per_s_high": max(rates),
    "compile_s": compile_s,
  }


def _compile(updates: Callable, state: Any, count: int) -> Callable:
  run = jax.jit(updates, static_argnums=2)
  compiled = run.lower(state, jax.random.key(0), count).compile()
  return lambda state: compiled(state, jax.random.key(0))


def _time(run: Callable, state: Any) -> float:
  began = time.perf_counter()
  jax.block_until_ready(run(state))
  return time.perf_counter() - began


@dataclasses.dataclass(frozen=True)
class ForgetfulHeads(Heads):
  """Heads that look at the observation again for every candidate."""

  observation: Observation

  def z(self, actions: Array) -> Array:
    """See ``Heads.z``; one candidate after the other, for the memory."""

    def one(action: Array) -> Array:
      # No action is beyond its limits, which the compiler cannot know: it would
      # otherwise take the features out of the loop.
      flip = jnp.any(action > 2.0)
      seen = jax.tree.map(lambda x: jnp.where(flip, 0 * x, x), self.observation)
      phi = self.networks.apply("encoder", self.params, seen)
      return self.networks.apply("z", self.params, phi, action[None])[0]

    return jax.lax.map(one, actions)


@dataclasses.dataclass(frozen=True)
class ForgetfulNetworks(Networks):
  """Networks whose value head does not share phi."""

  def at(self, params: Params, observation: Observation) -> Heads:
    """See ``Networks.at``."""
    phi = self.apply("encoder", params, observation)
    return ForgetfulHeads(self, params, phi, observation)


def forgetful_agent(config: AgentConfig) -> Agent:
  """The same agent without the features being computed once."""

  def build(*args: Any) -> ForgetfulNetworks:
    networks = make_networks(*args)
    return ForgetfulNetworks(networks.modules, networks.evaluation, networks.config)

  with mock.patch.object(learner, "make_networks", build):
    return make_agent(config)


def write(report: dict[str, Any]) -> None:
  """The table in docs/performance.md."""
  rates: dict[tuple[int, int], dict[str, float]] = {}
  for result in report["results"]:
    setting = (result["batch"], result["candidates"])
    rates.setdefault(setting, {})[result["phi"]] = result["updates_per_s"]
  head = ("batch", "candidates", "phi once, updates/s", "repeated", "times faster")
  rows = [
    (*setting, rate["once"], rate["repeated"], rate["once"] / rate["repeated"])
    for setting, rate in rates.items()
  ]
  note = f"{report['preset']}, {report['device']}, {report['cores']} cores."
  tables.put("learner", f"{note}\n\n{tables.table(head, rows)}")


if __name__ == "__main__":
  main()
