"""Training, steps and updates per second, and what an iteration consists of.

  python benchmarks/end_to_end.py --quick
  python benchmarks/end_to_end.py --store --backends native --tasks push_plate

The iteration of `apnpql train` with the preset of each task: rollouts with the policy,
then updates. Only the number of worlds differs; the replays are empty, which costs
nearly the same. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import sys
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import parts
import settings

from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.errors import ConfigError
from apnpql_jax.training.expert import empty_expert
from apnpql_jax.training.iteration import make_iteration, make_sample
from apnpql_jax.training.state import TrainState, initial_state


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__)
  settings.add_flags(parser)
  parser.add_argument("--rollout", type=int, help="periods; the preset's if left out")
  parser.add_argument("--updates", type=int, help="of an iteration; likewise")
  args = timing.parse(parser)
  timing.publish("end_to_end", args, measure_all(args))


def measure_all(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
  """Figures of every setting for which the memory suffices, one after the other."""
  for names, config in settings.chosen(args):
    config = dataclasses.replace(
      config,
      rollout_length=args.rollout or config.rollout_length,
      updates_per_iteration=args.updates or config.updates_per_iteration,
    )
    try:
      yield names | measure(config, args.repeats)
    except ConfigError as error:
      print(f"{names}: {error}", file=sys.stderr)


def measure(config: TrainConfig, repeats: int) -> dict[str, Any]:
  """Figures of one setting."""
  env = make_env(config.env, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  worlds, length = config.env.worlds, config.rollout_length
  updates = config.updates_per_iteration
  state = initial_state(config, env, agent, empty_expert)
  run, compile_s = timing.compiled(make_iteration(config, env, agent), state)
  for _ in range(parts.PLAYED):
    state, _ = run(state)
  period = parts.prepare(env, agent, state.learner.params, state.env)
  learning = learn(config, agent, state)
  # A copy, for an iteration takes the place of its state.
  iteration = timing.Carried(run, jax.tree.map(jnp.copy, state))
  floor_s = length * sum(part.floor_s for part in period.values()) + learning.floor_s
  ready = {"iteration": timing.Ready(iteration, floor_s), "learning": learning} | period
  measured = timing.measure(list(ready.values()), repeats=repeats)
  times = dict(zip(ready, measured, strict=True))
  whole = times["iteration"]
  found = {
    name: parts.Part(length * times[name].seconds, length * part.floor_s)
    for name, part in period.items()
  }
  found["learning"] = parts.Part(times["learning"].seconds, learning.floor_s)
  return {
    "rollout_length": length,
    "updates_per_iteration": updates,
    "batch": config.replay.batch_size,
    **whole.per(worlds * length).rate("step"),
    **whole.per(updates).rate("update"),
    "compile_s": compile_s,
    **floor.compare(floor_s, whole.seconds),
    "parts": parts.shares(whole.seconds, found),
  }


def learn(config: TrainConfig, agent: Agent, state: TrainState) -> timing.Ready:
  """The updates of an iteration by themselves: batches are drawn and learnt from."""
  sample = make_sample(config, agent)
  key = jax.random.key(0)

  def updates(learner: Any, ring: Any, expert: Any) -> tuple[Any, None]:
    def one(learner: Any, key: Any) -> tuple[Any, None]:
      return agent.update(learner, sample(ring, expert, key), key)[0], None

    return jax.lax.scan(one, learner, jax.random.split(key, count))

  count = config.updates_per_iteration
  rings = (state.replay, state.expert_replay)
  run, _ = timing.compiled(jax.jit(updates), state.learner, *rings)
  carried = timing.Carried(lambda learner: run(learner, *rings), state.learner)
  batch = jax.eval_shape(sample, *rings, key)
  work = floor.count(agent.update, state.learner, batch, key).times(count)
  return timing.Ready(carried, work.seconds())


if __name__ == "__main__":
  main()
