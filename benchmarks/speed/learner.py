"""Updates per second of the learner, by batch and candidates.

  python -m benchmarks.speed.learner --store
  python -m benchmarks.speed.learner --batch 64 --candidates 120 --lstm-instants 4

The agent is that of a preset; its transitions are noise. The features phi of a state
are computed once and serve all candidate actions. "bfloat16" is the same learner with
``agent.candidate_precision`` bfloat16. "repeated" encodes the images again for each
candidate, which the paper avoids.
"""

import argparse
from collections.abc import Iterator
import dataclasses
import functools
import itertools
import math
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from apnpql_jax.agents import learner
from apnpql_jax.agents.layers import PRODUCTS
from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.agents.networks import Heads, Networks, Params, make_networks
from apnpql_jax.config.schema import AgentConfig, TrainConfig
from apnpql_jax.types import Array, Observation, Transition
from benchmarks.common import command, floor, noise, settings, timing

Result = dict[str, Any]


def main() -> None:
  parser = command.parser(__doc__, repeats=5)
  parser.add_argument("--preset", default="push_plate")
  parser.add_argument("--batch", type=int, nargs="+", default=[32, 64, 128])
  parser.add_argument("--candidates", type=int, nargs="+", default=[30, 120])
  parser.add_argument("--lstm-instants", type=int, help="default: the preset's")
  parser.add_argument("--phi", nargs="+", choices=AGENTS, default=list(AGENTS))
  args = command.parse(parser)
  config = settings.preset(args.preset, quick=args.quick)
  if args.quick:
    args.batch, args.candidates = [8], [8]
  if args.lstm_instants is not None:
    config = settings.changed(config, "agent", lstm_instants=args.lstm_instants)
  header = {"preset": args.preset, "lstm_instants": config.agent.lstm_instants}
  command.publish("learner", args, measure_all(config, args), **header)


def measure_all(config: TrainConfig, args: argparse.Namespace) -> Iterator[Result]:
  """Yields the figures of every setting, with phi once and repeated."""
  for batch, candidates in itertools.product(args.batch, args.candidates):
    chosen = settings.changed(config, "replay", batch_size=batch)
    chosen = settings.with_candidates(chosen, candidates)
    transitions = noise.transitions(chosen)
    ready = {phi: prepare(AGENTS[phi](chosen.agent), transitions) for phi in args.phi}
    found = timing.figures("update", ready, repeats=args.repeats)
    for phi, figures in found.items():
      yield {"batch": batch, "candidates": candidates, "phi": phi, **figures}


def prepare(agent: Agent, transitions: Transition) -> timing.Ready:
  """Compiles updates in a loop, as in training; as many as fill a repeat."""
  key = jax.random.key(0)
  state = jax.jit(agent.init)(key, transitions.observation_tm1)

  @jax.jit
  def updates(state: Any, transitions: Transition, count: Any) -> Any:
    one = functools.partial(nth_update, agent, transitions)
    return jax.lax.fori_loop(0, count, one, state)

  run, compile_s = timing.compiled(updates, state, transitions, 1)
  run = functools.partial(run, state, transitions)
  floor_s = floor.count(agent.update, state, transitions, key).seconds()
  one = {"one": timing.Ready(functools.partial(run, 1), floor_s)}
  once = timing.measure(one, repeats=1, seconds=0.0)["one"]
  count = math.ceil(timing.SECONDS / once.seconds)
  return timing.Ready(functools.partial(run, count), floor_s, count, compile_s)


def nth_update(agent: Agent, transitions: Transition, index: Any, state: Any) -> Any:
  """Returns the state after one more update; a body of ``fori_loop``.

  Each update sees the transitions in another order. Otherwise XLA would move what
  depends on the batch alone out of the loop, such as converting its images.
  """
  batch = jax.tree.map(lambda x: jnp.roll(x, index, axis=0), transitions)
  key = jax.random.fold_in(jax.random.key(0), index)
  return agent.update(state, batch, key)[0]


@dataclasses.dataclass(frozen=True)
class ForgetfulHeads(Heads):
  """Heads that encode the observation again for every candidate."""

  observation: Observation

  def z(self, actions: Array, *, precision: str = "float32") -> Array:
    """See ``Heads.z``; takes one candidate at a time to save memory."""
    product = PRODUCTS[precision]

    def one(action: Array) -> Array:
      # Never true, because actions are bounded. The compiler cannot see that, and
      # therefore keeps the features in the loop.
      flip = jnp.any(action > 2.0)
      seen = jax.tree.map(lambda x: jnp.where(flip, 0 * x, x), self.observation)
      phi = self.networks.apply("encoder", self.params, seen)
      inputs = phi, action[None]
      return self.networks.apply("z", self.params, *inputs, product=product)[0]

    return jax.lax.map(one, actions)


@dataclasses.dataclass(frozen=True)
class ForgetfulNetworks(Networks):
  """Networks whose value head does not share phi."""

  def at(self, params: Params, observation: Observation) -> Heads:
    """See ``Networks.at``."""
    phi = self.apply("encoder", params, observation)
    return ForgetfulHeads(self, params, phi, observation.primitives, observation)


def forgetful_agent(config: AgentConfig) -> Agent:
  """Returns the agent that encodes images for every candidate."""

  def build(*args: Any) -> ForgetfulNetworks:
    return ForgetfulNetworks(**vars(make_networks(*args)))

  with mock.patch.object(learner, "make_networks", build):
    return make_agent(config)


def bfloat16_agent(config: AgentConfig) -> Agent:
  """Returns the agent whose candidates are valued in bfloat16 products."""
  return make_agent(dataclasses.replace(config, candidate_precision="bfloat16"))


AGENTS = {"once": make_agent, "bfloat16": bfloat16_agent, "repeated": forgetful_agent}
"""How often phi is computed, or in which precision the candidates -> the agent."""


if __name__ == "__main__":
  main()
