"""Updates per second of the learner, by batch and candidates.

  python benchmarks/learner.py --quick
  python benchmarks/learner.py --store
  python benchmarks/learner.py --batch 64 --candidates 120 --lstm-instants 4

The agent is that of a preset, its transitions are noise. The features phi of a state
are computed once and serve all candidate actions; "repeated" is the same learner that
looks at the images again for each of them, which is what the paper saves. ``--json``
prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import functools
import itertools
import math
import sys
from typing import Any
from unittest import mock

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import tables

from apnpql_jax import testing
from apnpql_jax.agents import learner
from apnpql_jax.agents.heads import Heads, Networks, Params
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.agents.networks import make_networks
from apnpql_jax.config.files import load_preset
from apnpql_jax.config.schema import AgentConfig
from apnpql_jax.types import Array, Observation, Transition

sys.path.append(str(tables.ROOT / "tests"))
from apnpql_jax.testing import random_batch


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, nargs="+", default=[32, 64, 128])
  parser.add_argument("--candidates", type=int, nargs="+", default=[30, 120])
  parser.add_argument("--lstm-instants", type=int, help="the preset's if left out")
  args = timing.parse(parser)
  config = load_preset(args.preset).agent
  if args.quick:
    args.batch, args.candidates, config = [8], [8], testing.TINY.agent
  if args.lstm_instants is not None:
    config = dataclasses.replace(config, lstm_instants=args.lstm_instants)
  header = {"preset": args.preset, "lstm_instants": config.lstm_instants}
  timing.publish("learner", args, measure_all(config, args), **header)


def measure_all(
  config: AgentConfig, args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
  """Figures of every setting, both ways of phi timed in turns."""
  for batch, candidates in itertools.product(args.batch, args.candidates):
    transitions = random_batch(0, batch, pixels=True, instants=config.lstm_instants)
    chosen = with_candidates(config, candidates)
    ways = {"once": make_agent, "repeated": forgetful_agent}
    ready = [prepare(build(chosen), transitions) for build in ways.values()]
    measured = timing.measure(ready, repeats=args.repeats)
    for phi, updates, times in zip(ways, ready, measured, strict=True):
      yield {
        "batch": batch,
        "candidates": candidates,
        "phi": phi,
        **updates.figures("update", times),
      }


def with_candidates(config: AgentConfig, count: int) -> AgentConfig:
  """The same agent with another number of candidates."""
  # Epsilon must stay below the log of the candidates; it costs no time.
  epsilon = min(config.epsilon, 1.0)
  return dataclasses.replace(
    config, target_samples=count, policy_samples=count, epsilon=epsilon
  )


def prepare(agent: Agent, transitions: Transition) -> timing.Ready:
  """Updates in a loop, where training has them, as many as fill a repeat."""
  key = jax.random.key(0)
  state = jax.jit(agent.init)(key, transitions.observation_tm1)

  @jax.jit
  def updates(state: Any, transitions: Transition, count: Any) -> Any:
    one = functools.partial(nth_update, agent, transitions)
    return jax.lax.fori_loop(0, count, one, state)

  run, compile_s = timing.compiled(updates, state, transitions, 1)
  run = functools.partial(run, state, transitions)
  floor_s = floor.count(agent.update, state, transitions, key).seconds()
  one = timing.Ready(functools.partial(run, 1), floor_s)
  (once,) = timing.measure([one], repeats=1, seconds=0.0)
  count = math.ceil(timing.SECONDS / once.seconds)
  return timing.Ready(functools.partial(run, count), floor_s, count, compile_s)


def nth_update(agent: Agent, transitions: Transition, index: Any, state: Any) -> Any:
  """The state after one more update, for a loop.

  Each has the transitions in another order. Otherwise XLA would take out of the loop
  what depends on the batch alone, such as turning its images from bytes to numbers.
  """
  batch = jax.tree.map(lambda x: jnp.roll(x, index, axis=0), transitions)
  key = jax.random.fold_in(jax.random.key(0), index)
  return agent.update(state, batch, key)[0]


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
    return ForgetfulNetworks(networks.modules, networks.value, networks.config)

  with mock.patch.object(learner, "make_networks", build):
    return make_agent(config)


if __name__ == "__main__":
  main()
