"""Training: steps and updates per second, and the parts of an iteration.

  python -m benchmarks.speed.end_to_end --store --backends native --tasks push_plate

The iteration of `apnpql train` with the preset of each task: rollouts with the policy,
then updates. Only the number of worlds differs. The replays are empty, which costs
nearly the same.
"""

from typing import Any

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import Agent, make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import make_env
from apnpql_jax.training.expert import empty_expert
from apnpql_jax.training.iteration import make_iteration, make_sample
from apnpql_jax.training.state import TrainState, initial_state
from benchmarks.common import command, floor, parts, settings, timing


def main() -> None:
  parser = command.parser(__doc__, repeats=5)
  settings.add_flags(parser)
  args = command.parse(parser)
  command.publish("end_to_end", args, settings.measure_each(args, measure))


def measure(config: TrainConfig, repeats: int) -> dict[str, Any]:
  """Returns the figures of one setting."""
  env = make_env(config.env, lstm_instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  worlds, length = config.env.worlds, config.rollout_length
  updates = config.updates_per_iteration
  state = initial_state(config, env, agent, empty_expert)
  run, compile_s = timing.compiled(make_iteration(config, env, agent), state)
  for _ in range(parts.PLAYED):
    state, _ = run(state)
  period = parts.prepare(env, agent, state.learner.params, state.env)
  pieces = {name: (length, part) for name, part in period.items()}
  pieces["learning"] = (1, learning(config, agent, state))
  floors = {name: n * (part.floor_s or 0.0) for name, (n, part) in pieces.items()}
  # A copy, because an iteration donates its state.
  iteration = timing.Carried(run, jax.tree.map(jnp.copy, state))
  ready = {name: part for name, (_, part) in pieces.items()}
  ready["iteration"] = timing.Ready(iteration, sum(floors.values()))
  times = timing.measure(ready, repeats=repeats)
  found = {k: (n * times[k].seconds, floors[k]) for k, (n, _) in pieces.items()}
  whole = times["iteration"]
  return {
    "rollout_length": length,
    "updates_per_iteration": updates,
    "batch": config.replay.batch_size,
    **whole.per(worlds * length).rate("step"),
    **whole.per(updates).rate("update"),
    "compile_s": compile_s,
    **floor.compare(sum(floors.values()), whole.seconds),
    "parts": parts.shares(whole.seconds, found),
  }


def learning(config: TrainConfig, agent: Agent, state: TrainState) -> timing.Ready:
  """Compiles the updates of an iteration alone, with drawing their batches."""
  sample = make_sample(config, agent)
  count, key = config.updates_per_iteration, jax.random.key(0)

  def updates(learner: Any, ring: Any, expert: Any) -> tuple[Any, None]:
    def one(learner: Any, key: Any) -> tuple[Any, None]:
      return agent.update(learner, sample(ring, expert, key), key)[0], None

    return jax.lax.scan(one, learner, jax.random.split(key, count))

  rings = (state.replay, state.expert_replay)
  run, _ = timing.compiled(jax.jit(updates), state.learner, *rings)
  carried = timing.Carried(lambda learner: run(learner, *rings), state.learner)
  batch = jax.eval_shape(sample, *rings, key)
  work = floor.count(agent.update, state.learner, batch, key).times(count)
  return timing.Ready(carried, work.seconds())


if __name__ == "__main__":
  main()
