"""Environment steps per second, without and with the policy, and what they consist of.

  python benchmarks/env_steps.py --quick
  python benchmarks/env_steps.py --store --backends native --tasks push_plate

A step is one control period of 0.15 s of one world, with its images. "env" acts at
random; "env_policy" is the rollout of training, with an untrained agent of the task's
preset. ``--json`` prints one JSON object and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
import functools
from typing import Any

import timing  # isort: skip  (before JAX: sets threads and cache)
import floor
import jax
import jax.numpy as jnp
import parts
import settings

from apnpql_jax.agents.learner import make_agent
from apnpql_jax.config import TrainConfig
from apnpql_jax.env import Env, EnvState, make_env
from apnpql_jax.rollout import Policy, agent_policy, rollout


def main() -> None:
  """Command line; see the module's docstring."""
  parser = timing.parser(__doc__)
  settings.add_flags(parser)
  args = timing.parse(parser)
  chosen = settings.chosen(args)
  results = (names | measure(config, args.repeats) for names, config in chosen)
  timing.publish("env_steps", args, results)


def measure(config: TrainConfig, repeats: int) -> dict[str, Any]:
  """Figures of one setting."""
  env = make_env(config.env, instants=config.agent.lstm_instants)
  agent = make_agent(config.agent)
  worlds, length = config.env.worlds, config.rollout_length
  state = jax.jit(env.reset)(jnp.arange(worlds) % env.bank_split)
  params = jax.jit(agent.init)(jax.random.key(0), state.seen).params
  found = parts.measure(env, agent, params, state, repeats=repeats)
  policies: dict[str, Callable[[Any], Policy]] = {
    "env": lambda params: parts.random_policy,
    "env_policy": functools.partial(agent_policy, agent, greedy=False),
  }
  figures: dict[str, Any] = {}
  for name, policy in policies.items():
    times, compile_s = play(env, policy, params, state, length=length, repeats=repeats)
    times = times.per(length * worlds)
    idle = "networks" if name == "env" else None
    floor_s = sum(part.floor_s for key, part in found.items() if key != idle)
    figures[name] = {
      **times.rate("step"),
      "compile_s": compile_s,
      **floor.compare(floor_s / worlds, times.seconds),
    }
  period_s = worlds / figures["env_policy"]["steps_per_s"]
  seconds = {name: part.seconds for name, part in found.items()}
  return figures | {"shares": parts.shares(period_s, seconds)}


def play(
  env: Env,
  policy: Callable[[Any], Policy],
  params: Any,
  state: EnvState,
  *,
  length: int,
  repeats: int,
) -> tuple[timing.Times, float]:
  """Times rollouts from ``state`` on; also returns the seconds of compilation."""

  def go_on(carry: Any, params: Any) -> Any:
    state, key = carry
    key, play_key = jax.random.split(key)
    state, slots = rollout(env, policy(params), state, play_key, length=length)
    return (state, key), slots

  carry = (state, jax.random.key(0))
  run, compile_s = timing.compiled(jax.jit(go_on), carry, params)
  rollouts = timing.Carried(lambda carry: run(carry, params), carry)
  return timing.measure(rollouts, repeats=repeats), compile_s


if __name__ == "__main__":
  main()
