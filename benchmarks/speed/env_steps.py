"""Environment steps per second, without and with the policy, and their parts.

  python -m benchmarks.speed.env_steps --store --backends native --tasks push_plate

A step is one control period of 0.15 s of one world, with its images. "env" acts at
random. "env_policy" is the rollout of training with an untrained agent of the task's
preset.
"""

from collections.abc import Callable
import functools
from typing import Any

import jax
import jax.numpy as jnp

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config.schema import TrainConfig
from apnpql_jax.envs.env import Env, make_env
from apnpql_jax.envs.state import EnvState
from apnpql_jax.training.rollout import WorldPolicy, agent_policy, rollout
from benchmarks.common import command, parts, settings, timing


def main() -> None:
  parser = command.parser(__doc__, repeats=5)
  settings.add_flags(parser)
  args = command.parse(parser)
  command.publish("env_steps", args, settings.measure_each(args, measure))


def measure(config: TrainConfig, repeats: int) -> dict[str, Any]:
  """Returns the figures of one setting."""
  env = make_env(config.env, lstm_instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  worlds, length = config.env.worlds, config.rollout_length
  state = env.reset(jnp.arange(worlds) % env.bank_split)
  params = jax.jit(agent.init)(jax.random.key(0), state.observation).params
  policies: dict[str, Callable[[Any], WorldPolicy]] = {
    "env": lambda params: parts.random_policy,
    "env_policy": functools.partial(agent_policy, agent, acting="policy"),
  }
  players = {}
  for name, policy in policies.items():
    players[name] = player(env, policy, params, state, length=length)
    run, _ = players[name]
    for _ in range(parts.PLAYED):
      run()
    state, _ = run.carry
  period = parts.prepare(env, agent, params, state)
  floors = {name: part.floor_s or 0.0 for name, part in period.items()}
  total_s = sum(floors.values()) / worlds
  whole = {"env": total_s - floors["networks"] / worlds, "env_policy": total_s}
  rollouts = {
    name: timing.Ready(run, whole[name], length * worlds, compile_s)
    for name, (run, compile_s) in players.items()
  }
  times = timing.measure(rollouts | period, repeats=repeats)
  found = {name: (times[name].seconds, floors[name]) for name in period}
  period_s = worlds * times["env_policy"].seconds
  return {
    **{name: run.figures("step", times[name]) for name, run in rollouts.items()},
    "parts": parts.shares(period_s, found),
  }


def player(
  env: Env,
  policy: Callable[[Any], WorldPolicy],
  params: Any,
  state: EnvState,
  *,
  length: int,
) -> tuple[timing.Carried, float]:
  """Returns rollouts that continue from ``state``, and the seconds of compilation."""

  def play(carry: Any, params: Any) -> Any:
    state, key = carry
    key, play_key = jax.random.split(key)
    state, slots = rollout(env, policy(params), state, play_key, length=length)
    return (state, key), slots

  carry = (state, jax.random.key(0))
  run, compile_s = timing.compiled(jax.jit(play), carry, params)
  return timing.Carried(lambda carry: run(carry, params), carry), compile_s


if __name__ == "__main__":
  main()
